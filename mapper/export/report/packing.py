"""Points and grids as compressed text inside a page; ``map/decoding.js`` reads them back."""

import base64
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.octree.keys import codes_of_keys

_STEPS = np.iinfo(np.uint16).max
"""Largest number of steps along an axis: positions are 16-bit integers."""
_LEVEL = 9

Plane = NDArray[np.uint8] | NDArray[np.uint16]


def pack_points(
    points: NDArray[np.floating], values: Sequence[Plane], *, step_m: float, most: int
) -> dict[str, Any]:
    """Return points as JSON: integers in Morton order, each as its difference from the one before.

    Args:
        points: (N, 3) metres.
        values: (N,) integers of every point; each becomes a plane of its own.
        step_m: Positions are rounded to multiples of this, or of more if the points lie further apart than
            16 bits can tell.
        most: Largest number of points; of more, evenly spread ones along the Morton curve are kept.
    """
    low = points.min(axis=0) if len(points) else np.zeros(3)
    reach_m = float((points.max(axis=0) - low).max()) if len(points) else 0.0
    step_m = max(step_m, reach_m / _STEPS)
    steps = np.rint((points - low) / step_m).astype(np.int64)
    order = np.argsort(codes_of_keys(steps), kind="stable")
    if len(order) > most:
        order = order[np.arange(most) * len(order) // most]
    planes = [steps[order, axis].astype(np.uint16) for axis in range(3)] + [plane[order] for plane in values]
    return {
        "count": len(order),
        "of": len(points),
        "low": [float(f"{v:.9g}") for v in low],
        "step": step_m,
        "data": _text(b"".join(map(_differences, planes))),
    }


def pack_layers(layers: Iterable[NDArray[np.uint8]]) -> dict[str, Any]:
    """Return layers of cells as JSON, compressed one by one so that a reader decodes only what it shows.

    Args:
        layers: (H, W) uint8 cells 0 … 3; four go into one byte, the first in the lowest bits.
    """
    parts = [zlib.compress(_quarters(layer).tobytes(), _LEVEL) for layer in layers]
    ends = np.cumsum([len(part) for part in parts]).tolist()
    return {"ends": ends, "data": _text(b"".join(parts), compress=False)}


def _differences(plane: Plane) -> bytes:
    """Return a plane's differences, wrapped around; of 16 bits all low bytes come before all high ones."""
    steps = np.diff(plane, prepend=plane.dtype.type(0))
    if steps.dtype == np.uint8:
        return steps.tobytes()
    signed = steps.astype(np.int16)
    zigzag = ((signed << 1) ^ (signed >> 15)).astype(np.uint16)
    return (zigzag & 0xFF).astype(np.uint8).tobytes() + (zigzag >> 8).astype(np.uint8).tobytes()


def _quarters(layer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    cells = np.zeros(-(-layer.size // 4) * 4, np.uint8)
    cells[: layer.size] = layer.reshape(-1)
    quarters: NDArray[np.uint8] = (cells.reshape(-1, 4) << np.array([0, 2, 4, 6], np.uint8)).sum(
        axis=1, dtype=np.uint8
    )
    return quarters


def _text(data: bytes, *, compress: bool = True) -> str:
    return base64.b64encode(zlib.compress(data, _LEVEL) if compress else data).decode("ascii")
