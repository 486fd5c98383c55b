"""File of a run's places: the features or points by which its keyframes are recognised without the log."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import RunError
from mapper.features.frame_view import ImageView
from mapper.loops.scan_context_proposer import ScanPlace
from mapper.runtime.checked_file import CheckedFormat

AnyPlace = ImageView | ScanPlace

_MAGIC = b"\x8bmapper places\n"
_FORMAT = CheckedFormat(_MAGIC, 1, "delete it, and places are read from the log again", RunError)
_IMAGES, _SCANS = b"images", b"scans"


def write_places(path: Path, places: Mapping[int, AnyPlace]) -> None:
    """Write places by node, of one sensor; single precision, but for poses. Atomic.

    Pixels keep 1e-4 px and depths 1e-6 of themselves; the points of features follow from them.
    """
    images = {node: place for node, place in places.items() if isinstance(place, ImageView)}
    scans = {node: place for node, place in places.items() if isinstance(place, ScanPlace)}
    kind, columns = (_IMAGES, _of_images(images)) if images else (_SCANS, _of_scans(scans))
    columns["node"] = np.array(list(places), np.int64)
    columns["stamp_ns"] = np.array([place.stamp_ns for place in places.values()], np.int64)
    body = io.BytesIO()
    np.savez_compressed(body, **columns)  # type: ignore[arg-type]
    _FORMAT.write(path, kind, body.getvalue())


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
    except (KeyError, ValueError, IndexError, zipfile.BadZipFile) as error:
        raise RunError(f"{path}: no file of places: {error}") from None


def _of_images(places: Mapping[int, ImageView]) -> dict[str, NDArray[Any]]:
    views = list(places.values())
    return {
        "count": np.array([len(view) for view in views], np.int64),
        "pixels": np.concatenate([view.pixels for view in views]).astype(np.float32),
        "sigma_px": np.concatenate([view.sigma_px for view in views]).astype(np.float32),
        "depth_m": np.concatenate([view.points_camera[:, 2] for view in views]).astype(np.float32),
        "descriptors": np.concatenate([view.descriptors for view in views]),
        "intrinsics": np.array([view.intrinsics for view in views]),
        "T_body_camera": np.array([view.T_body_camera for view in views]),
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


def _of_scans(places: Mapping[int, ScanPlace]) -> dict[str, NDArray[Any]]:
    scans = list(places.values())
    return {
        "count": np.array([len(scan.points_body) for scan in scans], np.int64),
        "points_body": np.concatenate([np.empty((0, 3), np.float32), *(scan.points_body for scan in scans)]),
        "T_level_body": np.array([scan.T_level_body for scan in scans]).reshape(-1, 4, 4),
    }


def _scans(table: Mapping[str, NDArray[Any]]) -> list[ScanPlace]:
    ends = np.cumsum(table["count"]).tolist()
    return [
        ScanPlace(int(stamp_ns), table["points_body"][begin:end], T_level_body)
        for stamp_ns, T_level_body, begin, end in zip(
            table["stamp_ns"], table["T_level_body"], [0, *ends[:-1]], ends, strict=True
        )
    ]
