"""Scan updates: the free and occupied voxels of one scan, packed, and the file of those of all frames.

From them a map is fused again without reading frames that did not move. One line of JSON has the settings
that the rays depend on. Then each frame in time order: a little-endian head (stamp, T_world_body, number of
blocks, number of bytes) and its compressed update. A map is a fold over updates, so merging those that still
hold and casting the others again gives the same bits as fusing from scratch.
"""

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from isal import isal_zlib
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError, MapFileError
from mapper.core.geometry import Transform, angle_between
from mapper.core.units import MIB
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import BLOCK_VOXELS, PACKED_BYTES
from mapper.octree.ray_casting import Cast, depth_limit_of
from mapper.octree.ray_casting_kernels import FREE, OCCUPIED, UNTOUCHED
from mapper.runtime.atomic import writing
from mapper.runtime.ordered_map import ordered_map

_UPDATE_BYTES = 8 + 2 * PACKED_BYTES  # of a block
_MOST_KEPT_BYTES = 128 * MIB
_LEVEL = 1  # of compression: cells are mostly runs, which higher levels shrink little further
_FORMAT = "mapper sights 1"  # the updates' former name: files with it are still read
_RAY_SETTINGS = {"resolution_m", "max_range_m", "depth_noise", "discretize"}
"""Settings that casting depends on; probabilities only matter when updates are merged."""
_HEAD = np.dtype([("stamp_ns", "<i8"), ("T_world_body", "<f8", (4, 4)), ("blocks", "<u4"), ("size", "<u4")])


@dataclass(frozen=True, slots=True, eq=False)
class ScanUpdate:
    """Free and occupied voxels of one scan, by block.

    Attributes:
        codes: (B,) int64 Morton codes of the blocks, increasing.
        free: (B, 64) uint8, bit v of a block set where voxel v, in Morton order, is free.
        occupied: (B, 64) uint8, the same where it is occupied.
    """

    codes: NDArray[np.int64]
    free: NDArray[np.uint8]
    occupied: NDArray[np.uint8]

    def __post_init__(self) -> None:
        planes = (len(self.codes), PACKED_BYTES)
        if self.free.shape != planes or self.occupied.shape != planes:
            raise DataError(f"scan update: planes {self.free.shape} and {self.occupied.shape}, want {planes}")

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self.codes)

    def cells(self) -> NDArray[np.uint8]:
        """Return the (B · 512,) uint8 cells, as casting writes them into a window."""
        cells = np.empty(len(self) * BLOCK_VOXELS, np.uint8)
        _unpack(self.free.reshape(-1), self.occupied.reshape(-1), cells)
        return cells

    def compress(self) -> bytes:
        """Return the update as compressed bytes, the same for the same update."""
        steps = np.diff(self.codes, prepend=np.int64(0)).astype("<i8")
        return isal_zlib.compress(steps.tobytes() + self.free.tobytes() + self.occupied.tobytes(), _LEVEL)


def pack(cast: Cast) -> ScanUpdate:
    """Return the update of a cast scan, and reset its window's cells to UNTOUCHED."""
    order = np.argsort(cast.codes)
    free, occupied = (np.empty((len(order), PACKED_BYTES), np.uint8) for _ in range(2))
    _pack(cast.window.cells, cast.positions[order], free, occupied)
    return ScanUpdate(cast.codes[order], free, occupied)


def decompress(data: bytes, *, blocks: int) -> ScanUpdate:
    """Return the update of a number of blocks from the bytes of ``ScanUpdate.compress``.

    Raises:
        DataError: The bytes are damaged.
    """
    try:
        plain = isal_zlib.decompress(data)
    except isal_zlib.error as error:  # type: ignore[misc]  # its stub says: an instance
        raise DataError(f"scan update of {blocks} blocks: damaged: {error}") from None
    if len(plain) != blocks * _UPDATE_BYTES:
        raise DataError(f"scan update of {blocks} blocks: damaged: {len(plain)} bytes")
    steps = np.frombuffer(plain, "<i8", count=blocks)
    free, occupied = np.frombuffer(plain, np.uint8, offset=8 * blocks).reshape(2, blocks, PACKED_BYTES)
    return ScanUpdate(np.cumsum(steps), free, occupied)


@dataclass(frozen=True, slots=True, eq=False)
class CachedUpdate:
    """A frame's scan update, compressed, with the pose at which it was cast.

    Attributes:
        stamp_ns: The frame's stamp.
        T_world_body: (4, 4) pose at which it was cast.
        blocks: Number of blocks in the update.
        data: The update, compressed.
    """

    stamp_ns: int
    T_world_body: Transform
    blocks: int
    data: bytes = field(repr=False)

    def update(self) -> ScanUpdate:
        """Return the update, decompress.

        Raises:
            DataError: It is damaged.
        """
        return decompress(self.data, blocks=self.blocks)


def cache_update(stamp_ns: int, T_world_body: Transform, update: ScanUpdate) -> CachedUpdate:
    """Return a frame's update, compressed to be written."""
    return CachedUpdate(stamp_ns, T_world_body, len(update), update.compress())


class ScanUpdateWriter:
    """Writer of a new file, frame by frame; a context manager. A full disk raises WriteError."""

    def __init__(self, path: Path, config: OctreeConfig) -> None:
        self._path = path
        with writing(path):
            self._file = path.open("wb")
            self._file.write(_first_line(config))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with writing(self._path):
            self._file.close()

    @property
    def folder(self) -> Path:
        """Folder of the file."""
        return self._path.parent

    def add(self, frame: CachedUpdate) -> None:
        """Append one frame."""
        head = np.array((frame.stamp_ns, frame.T_world_body, frame.blocks, len(frame.data)), dtype=_HEAD)
        with writing(self._path):
            self._file.write(head.tobytes())
            self._file.write(frame.data)

    def flush(self) -> None:
        """Hand what was written so far to the system."""
        with writing(self._path):
            self._file.flush()

    def reopen(self) -> "ScanUpdateFile":
        """Return a reader of what was written so far."""
        self.flush()
        return open_scan_updates(self._path)


class ScanUpdateFile:
    """Reader with access by stamp, from any thread; a context manager. Only heads are kept in memory."""

    def __init__(
        self, path: Path, first_line: bytes, heads: dict[int, tuple[NDArray[np.void], int]], within_m: float
    ) -> None:
        self.path = path
        self._within_m = within_m
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
        """Return the number of frames."""
        return len(self._heads)

    def entries(self, first: int = 0) -> Iterator[CachedUpdate]:
        """Yield every frame's update, in the order of the file, from the ``first``-th on."""
        for stamp_ns, (head, start) in islice(self._heads.items(), first, None):
            yield self._read(stamp_ns, head, start)

    def replay(self, *, workers: int) -> Callable[[], Iterator[ScanUpdate]]:
        """Return a function that yields every update, decompressed, in the order of the file.

        The first ones stay in memory, so that calling it again costs less.
        """
        kept: list[ScanUpdate] = []

        def updates() -> Iterator[ScanUpdate]:
            yield from kept
            kept_bytes = sum(len(update) for update in kept) * _UPDATE_BYTES
            for update in ordered_map(CachedUpdate.update, self.entries(len(kept)), workers=workers):
                kept_bytes += len(update) * _UPDATE_BYTES
                if kept_bytes <= _MOST_KEPT_BYTES:
                    kept.append(update)
                yield update

        return updates

    def holds_for(self, config: OctreeConfig) -> bool:
        """Return whether the updates were cast with the same settings."""
        return self._first_line == _first_line(config)

    def lookup(self, stamp_ns: int, T_world_body: Transform, *, config: OctreeConfig) -> CachedUpdate | None:
        """Return a frame's update if it still holds: no ray's end has moved further than ``within_m``.

        Args:
            stamp_ns: The frame's stamp.
            T_world_body: (4, 4) current estimate of its pose.
            config: Gives the maximum range.
        """
        if not self.holds(stamp_ns, T_world_body, config=config):
            return None
        return self._read(stamp_ns, *self._heads[stamp_ns])

    def _read(self, stamp_ns: int, head: NDArray[np.void], start: int) -> CachedUpdate:
        data = os.pread(self._descriptor, int(head["size"]), start)
        return CachedUpdate(stamp_ns, head["T_world_body"], int(head["blocks"]), data)

    def holds(self, stamp_ns: int, T_world_body: Transform, *, config: OctreeConfig) -> bool:
        """Return whether a frame has an update that still holds; see ``lookup``."""
        if stamp_ns not in self._heads:
            return False
        head, _ = self._heads[stamp_ns]
        moved_m = displacement_m(head["T_world_body"], T_world_body, range_m=longest_ray_m(config))
        return moved_m <= self._within_m


def displacement_m(T_a_body: Transform, T_b_body: Transform, *, range_m: float) -> float:
    """Return a bound on the distance between a point within range at two poses; 0 only for equal poses."""
    if np.array_equal(T_a_body, T_b_body):
        return 0.0
    shift_m = float(np.linalg.norm(T_a_body[:3, 3] - T_b_body[:3, 3]))
    angle_rad = angle_between(T_a_body[:3, :3], T_b_body[:3, :3])
    bound_m = shift_m + (range_m * angle_rad if angle_rad > 0.0 else 0.0)
    return max(bound_m, float(np.finfo(np.float64).tiny))


def longest_ray_m(config: OctreeConfig) -> float:
    """Return a bound on the length of rays: no pixel of a depth camera is more than 60° off its axis."""
    limit = depth_limit_of(config)
    return config.range_limit_m if limit is None else 2.0 * limit.depth_m


def open_scan_updates(path: Path, *, within_m: float = 1e-9) -> ScanUpdateFile:
    """Open a file of ``ScanUpdateWriter``.

    Args:
        path: The file.
        within_m: A frame's update holds if no end of a ray moves by more; the default tolerates the rounding
            of poses stored as text.

    Raises:
        MapFileError: The file cannot be read, is foreign or truncated.
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
    return ScanUpdateFile(path, first_line, heads, within_m)


def _head(raw: bytes) -> NDArray[np.void]:
    head: NDArray[np.void] = np.frombuffer(raw, dtype=_HEAD)[0]
    return head


def _first_line(config: OctreeConfig) -> bytes:
    settings = {"format": _FORMAT, **config.model_dump(mode="json", include=_RAY_SETTINGS)}
    return json.dumps(settings).encode() + b"\n"


@njit(cache=True, nogil=True)
def _pack(cells, positions, free, occupied):
    for i in range(len(positions)):
        start = positions[i] * BLOCK_VOXELS
        for byte in range(PACKED_BYTES):
            first = start + 8 * byte
            free_bits, occupied_bits = 0, 0
            for bit in range(8):
                free_bits |= (cells[first + bit] == FREE) << bit
                occupied_bits |= (cells[first + bit] == OCCUPIED) << bit
            free[i, byte], occupied[i, byte] = free_bits, occupied_bits
        cells[start : start + BLOCK_VOXELS] = UNTOUCHED


@njit(cache=True, nogil=True)
def _unpack(free, occupied, cells):
    """Write one cell per bit of the (N,) planes."""
    for i in range(len(free)):
        for bit in range(8):
            cells[8 * i + bit] = ((free[i] >> bit) & 1) * FREE + ((occupied[i] >> bit) & 1) * OCCUPIED
