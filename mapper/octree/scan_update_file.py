"""The file of all frames' sights, from which a map is made again without reading frames that did not move.

One line of JSON says what the rays depended on. Then each frame in time order: a little-endian head (stamp,
T_world_body, number of blocks, number of bytes) and its sight, compressed. A map is a fold over sights, so
replaying those that are still true and casting the others afresh gives the same bits as fusing from scratch.
"""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import MapFileError
from mapper.core.geometry import Transform, angle_between
from mapper.octree.config import OctreeConfig
from mapper.octree.scan_update import ScanUpdate, decompressed

_FORMAT = "mapper sights 1"
_RAY_KNOBS = frozenset({"resolution_m", "max_range_m", "discretize"})
"""What casting depends on; probabilities only matter when sights are merged."""
_HEAD = np.dtype([("stamp_ns", "<i8"), ("T_world_body", "<f8", (4, 4)), ("blocks", "<u4"), ("size", "<u4")])


@dataclass(frozen=True, slots=True, eq=False)
class CachedUpdate:
    """What a frame saw, and where from.

    Attributes:
        stamp_ns: The frame's stamp.
        T_world_body: (4, 4) pose at which it was cast.
        blocks: How many blocks it saw.
        data: Its sight, compressed.
    """

    stamp_ns: int
    T_world_body: Transform
    blocks: int
    data: bytes = field(repr=False)

    def update(self) -> ScanUpdate:
        """Return the sight.

        Raises:
            DataError: It is damaged.
        """
        return decompressed(self.data, blocks=self.blocks)


def cache_update(stamp_ns: int, T_world_body: Transform, update: ScanUpdate) -> CachedUpdate:
    """Return a sight ready to be written."""
    return CachedUpdate(stamp_ns, T_world_body, len(update), update.compressed())


class ScanUpdateWriter:
    """Appends frames to a new file; a context manager."""

    def __init__(self, path: Path, config: OctreeConfig) -> None:
        self._file = path.open("wb")
        self._file.write(_first_line(config))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, frame: CachedUpdate) -> None:
        """Append one frame."""
        head = np.array((frame.stamp_ns, frame.T_world_body, frame.blocks, len(frame.data)), dtype=_HEAD)
        self._file.write(head.tobytes())
        self._file.write(frame.data)


class ScanUpdateFile:
    """Random access by stamp, safe in any thread; a context manager. Only the heads are held in memory."""

    def __init__(self, path: Path, first_line: bytes, heads: dict[int, tuple[NDArray[np.void], int]]) -> None:
        self.path = path
        self._first_line = first_line
        self._heads = heads
        self._descriptor = os.open(path, os.O_RDONLY)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._descriptor)

    def __len__(self) -> int:
        """Return how many frames there are."""
        return len(self._heads)

    def holds_for(self, config: OctreeConfig) -> bool:
        """Tell whether rays cast with this configuration would see the same."""
        return self._first_line == _first_line(config)

    def lookup(self, stamp_ns: int, T_world_body: Transform, *, config: OctreeConfig) -> CachedUpdate | None:
        """Return a frame's sight if it still holds: no ray's end has moved further than ``stays_within_m``.

        Args:
            stamp_ns: The frame.
            T_world_body: (4, 4) where it is believed to have been by now.
            config: Says how long rays are and how far they may stray.
        """
        if not self.holds(stamp_ns, T_world_body, config=config):
            return None
        head, start = self._heads[stamp_ns]
        data = os.pread(self._descriptor, int(head["size"]), start)
        return CachedUpdate(stamp_ns, head["T_world_body"], int(head["blocks"]), data)

    def holds(self, stamp_ns: int, T_world_body: Transform, *, config: OctreeConfig) -> bool:
        """Tell whether a frame is known, and still where it was; see ``lookup``."""
        if stamp_ns not in self._heads:
            return False
        head, _ = self._heads[stamp_ns]
        return displacement_m(head["T_world_body"], T_world_body, range_m=config.max_range_m) <= (
            config.stays_within_m
        )


def displacement_m(T_a_body: Transform, T_b_body: Transform, *, range_m: float) -> float:
    """Return a bound on how far apart two poses put a point within a range; 0 only if they are the same."""
    if np.array_equal(T_a_body, T_b_body):
        return 0.0
    shift_m = float(np.linalg.norm(T_a_body[:3, 3] - T_b_body[:3, 3]))
    bound_m = shift_m + range_m * angle_between(T_a_body[:3, :3], T_b_body[:3, :3])
    return max(bound_m, float(np.finfo(np.float64).tiny))


def open_scan_updates(path: Path) -> ScanUpdateFile:
    """Open a file that ``ScanUpdateWriter`` wrote.

    Raises:
        MapFileError: It cannot be read, is foreign or truncated.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            first_line = file.readline(1 << 12)
            if not first_line.startswith(json.dumps({"format": _FORMAT}).encode()[:-1]):
                raise MapFileError(f"{path}: not {_FORMAT!r}; delete it, and every frame is fused afresh")
            heads: dict[int, tuple[NDArray[np.void], int]] = {}
            while file.tell() < size:
                raw = file.read(_HEAD.itemsize)
                end = file.tell() + int(_head(raw)["size"]) if len(raw) == _HEAD.itemsize else size + 1
                if end > size:
                    raise MapFileError(
                        f"{path}: truncated after {len(heads)} frames; "
                        "delete it, and every frame is fused afresh"
                    )
                heads[int(_head(raw)["stamp_ns"])] = (_head(raw), file.tell())
                file.seek(end)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read: {error.strerror}") from None
    return ScanUpdateFile(path, first_line, heads)


def _head(raw: bytes) -> NDArray[np.void]:
    head: NDArray[np.void] = np.frombuffer(raw, dtype=_HEAD)[0]
    return head


def _first_line(config: OctreeConfig) -> bytes:
    knobs = {"format": _FORMAT, **config.model_dump(mode="json", include=set(_RAY_KNOBS))}
    return json.dumps(knobs).encode() + b"\n"
