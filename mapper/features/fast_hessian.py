"""SURF's key points (fast Hessian detector): maxima of the determinant over pixels and scales, compiled."""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Image

LAYERS = 4  # filter sizes per octave; extrema are sought in the middle two
_DXY_WEIGHT = 0.81  # 0.9², corrects box filters for the mixed derivative (Bay et al. 2008, eq. 3)
_SCALE_PER_PX = 1.2 / 9.0  # a 9-pixel filter approximates a Gaussian of σ = 1.2
_BORDER = 2


def interest_points(gray: Image, octaves: int, threshold: float) -> NDArray[np.float64]:
    """Return (N, 6) row, column, scale, response, sign of the Laplacian, octave of every maximum.

    Fast Hessian detector (Bay, Ess, Tuytelaars & Van Gool 2008, §3), pixels and scales interpolated as in
    Brown & Lowe 2002. Octave o samples every 2ᵒ pixels with filters of (9 + 6·layer)·2ᵒ pixels.

    Args:
        gray: (H, W) uint8.
        octaves: Number of octaves; those whose filters exceed the image stay empty.
        threshold: Smallest response, grey levels squared.
    """
    integral = cv2.integral(gray)
    parts = [np.empty((0, 6))]
    for octave in range(octaves):
        step, largest = 1 << octave, (9 + 6 * (LAYERS - 1)) << octave
        if largest + 2 * step * _BORDER >= min(gray.shape):
            break
        shape = (LAYERS, gray.shape[0] // step, gray.shape[1] // step)
        responses, bright = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
        for layer in range(LAYERS):
            _respond(responses[layer], bright[layer], integral, (9 + 6 * layer) << octave, step)
        parts.append(_maxima(responses, bright, octave, threshold))
    return np.concatenate(parts)


@njit(cache=True, nogil=True)
def _respond(
    responses: NDArray[np.float32],
    bright: NDArray[np.bool_],
    integral: NDArray[np.int32],
    size: int,
    step: int,
) -> None:
    """Write the determinant of the Hessian, and whether its trace is positive, on a grid of pixels."""
    lobe, half = size // 3, size // 2
    across, inner = lobe - 1, lobe // 2  # half extents of the second-derivative boxes
    area_inv = np.float32(1.0 / (size * size))
    first = -(-half // step)
    for row in range(first, responses.shape[0]):
        y = row * step
        if y + half >= integral.shape[0] - 1:
            break
        far_above, near_above = integral[y - half], integral[y - inner]
        near_below, far_below = integral[y + inner + 1], integral[y + half + 1]
        top, bottom = integral[y - across], integral[y + across + 1]
        outer_top, outer_bottom = integral[y - lobe], integral[y + lobe + 1]
        centre_top, centre_bottom = integral[y], integral[y + 1]
        for column in range(first, (integral.shape[1] - 2 - half) // step + 1):
            x = column * step
            a, b = x - across, x + across + 1
            dyy = (far_below[b] - far_below[a]) - (far_above[b] - far_above[a])
            dyy -= 3 * ((near_below[b] - near_below[a]) - (near_above[b] - near_above[a]))
            c, d, e, f = x - half, x + half + 1, x - inner, x + inner + 1
            dxx = (bottom[d] - bottom[c]) - (top[d] - top[c])
            dxx -= 3 * ((bottom[f] - bottom[e]) - (top[f] - top[e]))
            g, h = x - lobe, x + lobe + 1
            dxy = (centre_top[x] - centre_top[g]) - (outer_top[x] - outer_top[g])
            dxy += (outer_bottom[h] - outer_bottom[x + 1]) - (centre_bottom[h] - centre_bottom[x + 1])
            dxy -= (centre_top[h] - centre_top[x + 1]) - (outer_top[h] - outer_top[x + 1])
            dxy -= (outer_bottom[x] - outer_bottom[g]) - (centre_bottom[x] - centre_bottom[g])
            xx, yy, xy = np.float32(dxx) * area_inv, np.float32(dyy) * area_inv, np.float32(dxy) * area_inv
            responses[row, column] = xx * yy - np.float32(_DXY_WEIGHT) * xy * xy
            bright[row, column] = xx + yy > 0


@njit(cache=True, nogil=True)
def _maxima(
    responses: NDArray[np.float32], bright: NDArray[np.bool_], octave: int, threshold: float
) -> NDArray[np.float64]:
    layers, rows, columns = responses.shape
    step = 1 << octave
    points = np.empty((rows * columns // 4 + 1, 6), np.float64)  # no two maxima of a layer touch
    count = 0
    for layer in range(1, layers - 1):
        for row in range(_BORDER, rows - _BORDER):
            for column in range(_BORDER, columns - _BORDER):
                response = responses[layer, row, column]
                if response <= threshold or not _is_maximum(responses, layer, row, column):
                    continue
                offset = _peak(responses[layer - 1 : layer + 2, row - 1 : row + 2, column - 1 : column + 2])
                if np.abs(offset).max() > 1.0 or count == len(points):
                    continue  # the quadratic has no peak here
                points[count, 0] = (row + offset[1]) * step
                points[count, 1] = (column + offset[2]) * step
                points[count, 2] = (9 + 6 * (layer + offset[0])) * step * _SCALE_PER_PX
                points[count, 3] = response
                points[count, 4] = 1.0 if bright[layer, row, column] else -1.0
                points[count, 5] = octave
                count += 1
    return points[:count].copy()


@njit(cache=True, nogil=True)
def _is_maximum(responses: NDArray[np.float32], layer: int, row: int, column: int) -> bool:
    response = responses[layer, row, column]
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
