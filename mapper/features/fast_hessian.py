"""SURF's key points (fast Hessian detector): maxima of the determinant over pixels and scales, compiled."""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Image

SCALE_PER_PX = 1.2 / 9.0
"""A filter of 9 pixels approximates derivatives of a Gaussian with σ = 1.2 px."""

_DXY_WEIGHT = 0.81  # 0.9², corrects box filters for the mixed derivative (Bay et al. 2008, eq. 3)
_MIN_SIZE_PX, _SIZE_STEP_PX = 9, 6  # of the filters in octave 0; both double with each octave


def interest_points(gray: Image, *, octaves: int, layers: int, threshold: float) -> NDArray[np.float32]:
    """Return (N, 4) column, row, filter size in pixels and response of every maximum.

    Fast Hessian detector (Bay, Ess, Tuytelaars & Van Gool 2008, §3) with the scale space that OpenCV's
    manual describes: octave o samples every 2ᵒ pixels with ``layers`` + 2 filters of (9 + 6·layer)·2ᵒ
    pixels, and each box of a filter counts by its mean. Pixels and sizes are interpolated as in Brown & Lowe
    2002, sizes then rounded.

    Args:
        gray: (H, W) uint8.
        octaves: Number of octaves; those whose filters exceed the image stay empty.
        layers: Number of filter sizes per octave in which maxima are sought, between two more.
        threshold: Smallest response, grey levels squared; the scale is that of OpenCV's Hessian threshold.

    Returns:
        The points by octave, layer, row and column.
    """
    integral = cv2.integral(gray)
    parts = [np.empty((0, 4), np.float32)]
    for octave in range(octaves):
        step = 1 << octave
        largest_px = (_MIN_SIZE_PX + _SIZE_STEP_PX * (layers + 1)) << octave
        if largest_px + 2 * step >= min(gray.shape):
            break
        responses = np.empty((layers + 2, gray.shape[0] // step, gray.shape[1] // step), np.float32)
        for layer in range(layers + 2):
            _respond(responses[layer], integral, _MIN_SIZE_PX + _SIZE_STEP_PX * layer, step)
        parts.append(_maxima(responses, step, threshold))
    return np.concatenate(parts)


@njit(cache=True, nogil=True)
def _respond(responses: NDArray[np.float32], integral: NDArray[np.int32], size: int, step: int) -> None:
    """Write the determinant of the Hessian on a grid of pixels, where the filter lies within the image.

    Rows of sums are formed first and every column is worked out, even where ``step`` skips it: loops over
    whole rows run on vector instructions.

    Args:
        responses: (H // step, W // step).
        integral: (H + 1, W + 1).
        size: Width of the filter, in steps: an odd multiple of 3.
        step: Pixels between two responses.
    """
    half, lobe = size // 2, size // 3 * step
    width = size * step
    low, high = _scaled(2, lobe), _scaled(7, lobe)  # the second derivative's boxes, across
    a, b, c, d = _scaled(1, lobe), _scaled(4, lobe), _scaled(5, lobe), _scaled(8, lobe)  # mixed derivative
    per_second = np.float32(1.0 / (lobe * (high - low)))
    per_mixed = np.float32(1.0 / ((b - a) * (b - a)))
    count = integral.shape[1] - width
    yy, xx, xy = np.empty((3, integral.shape[1]), np.int32)
    every = np.empty(count, np.float32)
    for row in range(half, (integral.shape[0] - 1 - width) // step + half + 1):
        top = (row - half) * step
        _second_difference(
            yy, integral[top], integral[top + lobe], integral[top + 2 * lobe], integral[top + width]
        )
        _difference(xx, integral[top + low], integral[top + high])
        _mixed_difference(xy, integral[top + a], integral[top + b], integral[top + c], integral[top + d])
        line = responses[row, half : half + count] if step == 1 else every
        _determinants(
            line,
            (xx[:count], xx[lobe:], xx[2 * lobe :], xx[width:]),
            (yy[low:], yy[high:]),
            (xy[a:], xy[b:], xy[c:], xy[d:]),
            per_second,
            per_mixed,
        )
        if step > 1:
            used = every[::step]
            responses[row, half : half + len(used)] = used


@njit(cache=True, nogil=True)
def _determinants(
    line: NDArray[np.float32],
    xx: tuple[NDArray[np.int32], ...],
    yy: tuple[NDArray[np.int32], ...],
    xy: tuple[NDArray[np.int32], ...],
    per_second: np.float32,
    per_mixed: np.float32,
) -> None:
    """Write the determinant of the Hessian along a row, from sums of columns at the edges of the boxes."""
    xx0, xx1, xx2, xx3 = xx
    for k in range(len(line)):
        line[k] = np.float32(np.int32(xx3[k] - xx0[k] - 3 * (xx2[k] - xx1[k]))) * per_second
    yy0, yy1 = yy
    for k in range(len(line)):
        line[k] *= np.float32(np.int32(yy1[k] - yy0[k])) * per_second
    xy0, xy1, xy2, xy3 = xy
    for k in range(len(line)):
        mixed = np.float32(np.int32(xy1[k] - xy0[k] - xy3[k] + xy2[k])) * per_mixed
        line[k] -= np.float32(_DXY_WEIGHT) * mixed * mixed


@njit(cache=True, nogil=True)
def _difference(out: NDArray[np.int32], a: NDArray[np.int32], b: NDArray[np.int32]) -> None:
    for k in range(len(out)):
        out[k] = b[k] - a[k]


@njit(cache=True, nogil=True)
def _second_difference(
    out: NDArray[np.int32],
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    d: NDArray[np.int32],
) -> None:
    for k in range(len(out)):
        out[k] = d[k] - a[k] - 3 * (c[k] - b[k])


@njit(cache=True, nogil=True)
def _mixed_difference(
    out: NDArray[np.int32],
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    d: NDArray[np.int32],
) -> None:
    for k in range(len(out)):
        out[k] = b[k] - a[k] - d[k] + c[k]


@njit(cache=True, nogil=True)
def _scaled(ninths: int, lobe: int) -> int:
    """Return the nearest pixel to a number of ninths of a filter of three lobes; never half-way."""
    return (2 * ninths * lobe + 3) // 6


@njit(cache=True, nogil=True)
def _maxima(responses: NDArray[np.float32], step: int, threshold: float) -> NDArray[np.float32]:
    """Return the points that exceed the threshold and their 26 neighbours, interpolated."""
    layers, rows, columns = responses.shape
    points = np.empty((rows * columns // 4 * layers + 1, 4), np.float32)  # no two maxima of a layer touch
    count = 0
    for layer in range(1, layers - 1):
        size = _MIN_SIZE_PX + _SIZE_STEP_PX * layer
        border = (size + _SIZE_STEP_PX) // 2 + 1  # the next filter's, and the neighbours'
        for row in range(border, rows - border):
            for column in range(border, columns - border):
                response = responses[layer, row, column]
                if response <= threshold or not _is_maximum(responses, layer, row, column):
                    continue
                offset = _peak(responses[layer - 1 : layer + 2, row - 1 : row + 2, column - 1 : column + 2])
                if np.abs(offset).max() > 1.0:
                    continue  # the quadratic has no peak here
                # A response belongs to the middle of the block of step × step pixels.
                points[count, 0] = (column + offset[2]) * step + 0.5 * (step - 1)
                points[count, 1] = (row + offset[1]) * step + 0.5 * (step - 1)
                points[count, 2] = np.rint((size + _SIZE_STEP_PX * offset[0]) * step)
                points[count, 3] = response
                count += 1
    return points[:count].copy()


@njit(cache=True, nogil=True)
def _is_maximum(responses: NDArray[np.float32], layer: int, row: int, column: int) -> bool:
    response = responses[layer, row, column]
    if responses[layer, row, column - 1] >= response or responses[layer, row, column + 1] >= response:
        return False  # most others end here
    for i in range(layer - 1, layer + 2):
        for j in range(row - 1, row + 2):
            for k in range(column - 1, column + 2):
                if responses[i, j, k] >= response and not (i == layer and j == row and k == column):
                    return False
    return True


@njit(cache=True, nogil=True)
def _peak(cube: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the peak (layer, row, column) of the quadratic through a (3, 3, 3) cube, relative to its middle.

    Cramer's rule on H·offset = -gradient; infinite where H is singular.
    """
    middle = cube[1, 1, 1]
    gs, gy, gx = (
        0.5 * (cube[2, 1, 1] - cube[0, 1, 1]),
        0.5 * (cube[1, 2, 1] - cube[1, 0, 1]),
        0.5 * (cube[1, 1, 2] - cube[1, 1, 0]),
    )
    ss = cube[2, 1, 1] + cube[0, 1, 1] - 2.0 * middle
    yy = cube[1, 2, 1] + cube[1, 0, 1] - 2.0 * middle
    xx = cube[1, 1, 2] + cube[1, 1, 0] - 2.0 * middle
    sy = 0.25 * (cube[2, 2, 1] + cube[0, 0, 1] - cube[2, 0, 1] - cube[0, 2, 1])
    sx = 0.25 * (cube[2, 1, 2] + cube[0, 1, 0] - cube[2, 1, 0] - cube[0, 1, 2])
    yx = 0.25 * (cube[1, 2, 2] + cube[1, 0, 0] - cube[1, 2, 0] - cube[1, 0, 2])
    determinant = ss * (yy * xx - yx * yx) - sy * (sy * xx - yx * sx) + sx * (sy * yx - yy * sx)
    offset = np.full(3, np.inf)
    if determinant != 0.0:
        offset[0] = -(gs * (yy * xx - yx * yx) - sy * (gy * xx - yx * gx) + sx * (gy * yx - yy * gx))
        offset[1] = -(ss * (gy * xx - yx * gx) - gs * (sy * xx - yx * sx) + sx * (sy * gx - gy * sx))
        offset[2] = -(ss * (yy * gx - gy * yx) - sy * (sy * gx - gy * sx) + gs * (sy * yx - yy * sx))
        offset /= determinant
    return offset
