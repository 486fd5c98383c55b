"""File of a run's places: the features or points by which its keyframes are recognised without the log."""

import io
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import RunError
from mapper.features.frame_view import ImageView
from mapper.loops.scan_context_proposer import ScanPlace
from mapper.runtime.atomic import writing
from mapper.runtime.checked_file import CheckedFormat

AnyPlace = ImageView | ScanPlace

_MAGIC = b"\x8bmapper places\n"
_FORMAT = CheckedFormat(_MAGIC, 1, "delete it, and places are read from the log again", RunError)
_IMAGES, _SCANS = b"images", b"scans"


def write_places(path: Path, places: Mapping[int, AnyPlace], nodes: Iterable[int] | None = None) -> None:
    """Write places by node, of one sensor; single precision, but for poses. Atomic.

    Pixels keep 1e-4 px and depths 1e-6 of themselves; the points of features follow from them. Each place is
    read once, and none is kept: there may be more than fit into memory.

    Args:
        path: The file.
        places: Features or scans by which the nodes are recognised.
        nodes: Nodes to write; None is all.
    """
    with ExitStack() as stack:
        stack.enter_context(writing(path))
        table = defaultdict[str, _Column](
            lambda: _Column(stack.enter_context(TemporaryFile(dir=path.parent)))
        )
        kind = _SCANS
        for node in places if nodes is None else nodes:
            place = places[node]
            if isinstance(place, ImageView):
                kind, columns = _IMAGES, _of_image(place)
            else:
                columns = _of_scan(place)
            columns |= {"node": np.array([node], np.int64), "stamp_ns": np.array([place.stamp_ns], np.int64)}
            for name, rows in columns.items():
                table[name].append(rows)
        body = stack.enter_context(TemporaryFile(dir=path.parent))
        arrays = {name: column.array() for name, column in table.items()}
        np.savez_compressed(body, **arrays)  # type: ignore[arg-type]
        _FORMAT.write_from(path, kind, body)


class _Column:
    """Array on the disk that grows along its first axis."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._shape: tuple[int, ...] = (0,)
        self._kind = np.dtype(np.uint8)

    def append(self, rows: NDArray[Any]) -> None:
        """Append rows, all of one type and shape."""
        self._file.write(np.ascontiguousarray(rows).data)
        self._shape, self._kind = (self._shape[0] + len(rows), *rows.shape[1:]), rows.dtype

    def array(self) -> NDArray[Any]:
        """Return the rows, which are read when they are used."""
        self._file.flush()
        if 0 in self._shape:
            return np.zeros(self._shape, self._kind)
        return np.memmap(self._file, self._kind, "r", shape=self._shape)


def read_places(path: Path) -> dict[int, AnyPlace]:
    """Return what ``write_places`` wrote.

    Raises:
        RunError: The file cannot be read, is another one, or is damaged.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror}") from None
    if not data.startswith(_MAGIC):
        raise RunError(f"{path}: no file of places")
    kind, body = _FORMAT.split(path, data)
    try:
        with np.load(io.BytesIO(body)) as columns:
            table = {name: columns[name] for name in columns.files}
        places = _images(table) if kind == _IMAGES else _scans(table)
        return dict(zip(table["node"].tolist(), places, strict=True))
    except (KeyError, ValueError, IndexError, NotImplementedError, zipfile.BadZipFile) as error:
        raise RunError(f"{path}: no file of places: {error}") from None


def _of_image(view: ImageView) -> dict[str, NDArray[Any]]:
    return {
        "count": np.array([len(view)], np.int64),
        "pixels": view.pixels.astype(np.float32),
        "sigma_px": view.sigma_px.astype(np.float32),
        "depth_m": view.points_camera[:, 2].astype(np.float32),
        "descriptors": view.descriptors,
        "intrinsics": view.intrinsics[np.newaxis],
        "T_body_camera": view.T_body_camera[np.newaxis],
    }


def _images(table: Mapping[str, NDArray[Any]]) -> list[ImageView]:
    ends = np.cumsum(table["count"]).tolist()
    views = []
    for k, (begin, end) in enumerate(zip([0, *ends], ends, strict=False)):
        pixels = table["pixels"][begin:end].astype(np.float64)
        depth_m = table["depth_m"][begin:end].astype(np.float64)
        intrinsics = table["intrinsics"][k]
        rays = (pixels - intrinsics[2:4]) / intrinsics[:2]
        views.append(
            ImageView(
                stamp_ns=int(table["stamp_ns"][k]),
                pixels=pixels,
                sigma_px=table["sigma_px"][begin:end].astype(np.float64),
                descriptors=table["descriptors"][begin:end],
                points_camera=np.column_stack([rays * depth_m[:, np.newaxis], depth_m]),
                intrinsics=intrinsics,
                T_body_camera=table["T_body_camera"][k],
            )
        )
    return views


def _of_scan(scan: ScanPlace) -> dict[str, NDArray[Any]]:
    return {
        "count": np.array([len(scan.points_body)], np.int64),
        "points_body": scan.points_body,
        "T_level_body": scan.T_level_body[np.newaxis],
    }


def _scans(table: Mapping[str, NDArray[Any]]) -> list[ScanPlace]:
    ends = np.cumsum(table["count"]).tolist()
    return [
        ScanPlace(int(stamp_ns), table["points_body"][begin:end], T_level_body)
        for stamp_ns, T_level_body, begin, end in zip(
            table["stamp_ns"], table["T_level_body"], [0, *ends[:-1]], ends, strict=True
        )
    ]
