"""SURF features (Bay, Ess, Tuytelaars & Van Gool 2008), compiled."""

from functools import cache

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.features.base import Features
from mapper.features.config import SurfConfig
from mapper.features.fast_hessian import SCALE_PER_PX, interest_points

_SIZE_OF_OCTAVE_0 = 18.0  # pixels, between the filters of 15 and 21 in which its points are found
DIMENSIONS = 64
_ORIENTATION_RADIUS, _ORIENTATION_SIGMA = 6, 2.5  # in scales
_TURN_DEG, _WINDOW_DEG, _WINDOW_STEP_DEG = 360, 59, 5  # of whole degrees, those less than 30 from a middle
_SAMPLES = 20  # per side of the descriptor's window, one scale apart
_CELLS = 4  # per side; each holds 5 × 5 samples
_DESCRIPTOR_SIGMA = 3.3  # in scales
_COARSEST_SCALE = 3.0  # beyond it the window is read from a smaller image


class Surf:
    """SURF detector with 64 numbers a feature and OpenCV's scale of the threshold.

    No release of OpenCV on PyPI contains its own SURF for a current Python; this one agrees with it to
    hundredths of a pixel and degrees (``tests/features/test_surf.py``).
    """

    scale_factor = 2.0

    def __init__(self, config: SurfConfig) -> None:
        self._config = config

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image, strongest first; none where it has no texture."""
        config = self._config
        points = interest_points(
            gray, octaves=config.octaves, layers=config.layers, threshold=config.min_threshold
        )
        points = points[np.argsort(-points[:, 3], kind="stable")]
        threshold = config.threshold
        while threshold > config.min_threshold and (points[:, 3] >= threshold).sum() < config.enough_features:
            threshold *= 0.5
        points = points[points[:, 3] >= max(threshold, config.min_threshold)][: config.max_features]
        angles_rad = orientations(gray, points)
        return Features(
            pixels=points[:, :2].copy(),
            octave=np.rint(np.log2(points[:, 2] / _SIZE_OF_OCTAVE_0)).clip(0.0).astype(np.int32),
            angle_rad=angles_rad,
            response=points[:, 3].copy(),
            descriptors=describe(gray, points, angles_rad),
        )


def orientations(gray: Image, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (N,) angles of the strongest gradient around points, from the column axis to the row axis.

    Haar wavelets of 4 scales on a disc of 6 scales, summed over a window of 60° that turns by 5° (§4.1).

    Args:
        gray: (H, W) uint8.
        points: (N, 3+) column, row and filter size in pixels.
    """
    turned: NDArray[np.float32] = _orientations(cv2.integral(gray), points, _gaussian(13, _ORIENTATION_SIGMA))
    return turned


def describe(
    gray: Image, points: NDArray[np.float32], angles_rad: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return (N, 64) descriptors of unit length: Σdx, Σdy, Σ|dx|, Σ|dy| of 4 × 4 cells (§4.2).

    As in OpenCV the turned window of 21 × 21 scales is read from the image at one sample a pixel, averaged
    to one a scale, and the differences between neighbours are the gradients. Large windows are read from an
    image that was halved by means, which gives the same averages at less cost.

    Args:
        gray: (H, W) uint8.
        points: (N, 3+) column, row and filter size in pixels.
        angles_rad: (N,).
    """
    halvings = np.zeros(len(points), np.int64)
    scales = points[:, 2] * np.float32(SCALE_PER_PX)
    while (too_coarse := scales > _COARSEST_SCALE).any():
        halvings[too_coarse] += 1
        scales[too_coarse] *= 0.5
    descriptors = np.empty((len(points), DIMENSIONS), np.float32)
    weights = _gaussian(_SAMPLES, _DESCRIPTOR_SIGMA)
    image = gray.astype(np.float32)
    for level in range(int(halvings.max(initial=-1)) + 1):
        if level:
            half = (max(image.shape[1] // 2, 1), max(image.shape[0] // 2, 1))
            image = cv2.resize(image[: 2 * half[1], : 2 * half[0]], half, interpolation=cv2.INTER_AREA)
        at = np.flatnonzero(halvings == level)
        centres = (points[at, :2] + np.float32(0.5)) * np.float32(0.5**level) - np.float32(0.5)
        descriptors[at] = _describe(image, centres, scales[at], angles_rad[at], weights)
    return descriptors


@cache
def _gaussian(count: int, sigma: float) -> NDArray[np.float32]:
    """Return the (count,) weights of a Gaussian about the middle."""
    weights: NDArray[np.float32] = cv2.getGaussianKernel(count, sigma, cv2.CV_32F).ravel()
    weights.setflags(write=False)
    return weights


@njit(cache=True, nogil=True)
def _orientations(
    integral: NDArray[np.int32], points: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.float32]:
    angles_rad = np.empty(len(points), np.float32)
    along_x, along_y = np.empty((2, _TURN_DEG + _WINDOW_DEG), np.float32)
    for n in range(len(points)):
        scale = points[n, 2] * np.float32(SCALE_PER_PX)
        half = int(np.rint(np.float32(2.0) * scale))
        left, top = points[n, 0] - half + np.float32(0.5), points[n, 1] - half + np.float32(0.5)
        along_x[:], along_y[:] = 0.0, 0.0
        for i in range(-_ORIENTATION_RADIUS, _ORIENTATION_RADIUS + 1):
            row = int(np.rint(top + i * scale))
            if row < 0 or row + 2 * half >= integral.shape[0]:
                continue
            above, middle, below = integral[row], integral[row + half], integral[row + 2 * half]
            for j in range(-_ORIENTATION_RADIUS, _ORIENTATION_RADIUS + 1):
                x = int(np.rint(left + j * scale))
                if i * i + j * j > _ORIENTATION_RADIUS**2 or x < 0 or x + 2 * half >= integral.shape[1]:
                    continue
                m, r = x + half, x + 2 * half
                whole = below[r] - below[x] - above[r] + above[x]
                weight = weights[i + _ORIENTATION_RADIUS] * weights[j + _ORIENTATION_RADIUS]
                left_half = below[m] - below[x] - above[m] + above[x]
                upper_half = middle[r] - middle[x] - above[r] + above[x]
                dx = weight * np.float32(whole - 2 * left_half)
                dy = weight * np.float32(whole - 2 * upper_half)
                k = (int(_degrees(dy, dx) + np.float32(0.5)) + _WINDOW_DEG // 2) % _TURN_DEG
                along_x[k] += dx
                along_y[k] += dy
        along_x[_TURN_DEG:], along_y[_TURN_DEG:] = along_x[:_WINDOW_DEG], along_y[:_WINDOW_DEG]
        best, x_best, y_best = np.float32(-1.0), np.float32(1.0), np.float32(0.0)
        x_sum, y_sum = np.float32(along_x[:_WINDOW_DEG].sum()), np.float32(along_y[:_WINDOW_DEG].sum())
        for k in range(_TURN_DEG):
            squared = x_sum * x_sum + y_sum * y_sum
            if k % _WINDOW_STEP_DEG == 0 and squared > best:
                best, x_best, y_best = squared, x_sum, y_sum
            x_sum += along_x[k + _WINDOW_DEG] - along_x[k]
            y_sum += along_y[k + _WINDOW_DEG] - along_y[k]
        angles_rad[n] = np.arctan2(y_best, x_best)
    return angles_rad


@njit(cache=True, nogil=True)
def _degrees(y: np.float32, x: np.float32) -> np.float32:
    """Return the angle of a vector in [0, 360], right to 0.001° (Abramowitz & Stegun 1964, eq. 4.4.47)."""
    far, near = max(abs(x), abs(y)), min(abs(x), abs(y))
    if far == np.float32(0.0):
        return np.float32(0.0)
    t = near / far
    s = t * t
    series = np.float32(-0.0851330) + np.float32(0.0208351) * s
    series = np.float32(-0.3302995) + s * (np.float32(0.1801410) + s * series)
    angle = np.float32(180.0 / np.pi) * t * (np.float32(0.9998660) + s * series)
    if abs(y) > abs(x):
        angle = np.float32(90.0) - angle
    if x < 0:
        angle = np.float32(180.0) - angle
    return np.float32(360.0) - angle if y < 0 else angle


@njit(cache=True, nogil=True)
def _describe(
    image: NDArray[np.float32],
    centres: NDArray[np.float32],
    scales: NDArray[np.float32],
    angles_rad: NDArray[np.float32],
    weights: NDArray[np.float32],
) -> NDArray[np.float32]:
    descriptors = np.empty((len(centres), DIMENSIONS), np.float32)
    patch = np.empty((_SAMPLES + 1, _SAMPLES + 1), np.float32)
    for n in range(len(centres)):
        _read_patch(patch, image, centres[n, 0], centres[n, 1], scales[n], angles_rad[n])
        _sum_gradients(descriptors[n], patch, weights)
    return descriptors


@njit(cache=True, nogil=True)
def _read_patch(
    patch: NDArray[np.float32],
    image: NDArray[np.float32],
    column: np.float32,
    row: np.float32,
    scale: np.float32,
    angle_rad: np.float32,
) -> None:
    """Write the means of a turned window, one for each square of a scale; borders go on beyond the image."""
    cells = len(patch)
    count = max(int(cells * scale), cells)
    per_sample = np.float32(cells / count)  # of a cell, along one side
    cos, sin = np.float32(np.cos(angle_rad)), np.float32(np.sin(angle_rad))
    first = np.float32(-0.5 * (count - 1))
    values, sums = np.empty(count, np.float32), np.zeros(count, np.float32)
    cell, room = 0, np.float32(1.0)  # the patch's row that is being filled, and what is missing in it
    for i in range(count):
        down = first + np.float32(i)
        _read_line(values, image, column + first * cos - down * sin, row + first * sin + down * cos, cos, sin)
        share = min(room, per_sample)
        for j in range(count):
            sums[j] += share * values[j]
        room -= share
        if room <= np.float32(1e-4) or i == count - 1:
            _sum_cells(patch[cell], sums, per_sample)
            rest = per_sample - share
            for j in range(count):
                sums[j] = rest * values[j]
            cell, room = min(cell + 1, cells - 1), np.float32(1.0) - rest


@njit(cache=True, nogil=True)
def _read_line(
    values: NDArray[np.float32],
    image: NDArray[np.float32],
    x: np.float32,
    y: np.float32,
    cos: np.float32,
    sin: np.float32,
) -> None:
    """Write an image's values along a line from (x, y), one a pixel, bilinearly interpolated."""
    last_x, last_y = np.float32(image.shape[1] - 1), np.float32(image.shape[0] - 1)
    most_x, most_y = np.int32(image.shape[1] - 2), np.int32(image.shape[0] - 2)
    for j in range(len(values)):
        step = np.float32(j)
        at_x = min(max(x + step * cos, np.float32(0.0)), last_x)
        at_y = min(max(y + step * sin, np.float32(0.0)), last_y)
        left, top = min(np.int32(at_x), most_x), min(np.int32(at_y), most_y)
        u, v = at_x - np.float32(left), at_y - np.float32(top)
        k, m = np.uintp(left), np.uintp(top)  # unsigned, as negative ones would be tested for
        next_k, next_m = k + np.uintp(1), m + np.uintp(1)
        upper = image[m, k] + u * (image[m, next_k] - image[m, k])
        lower = image[next_m, k] + u * (image[next_m, next_k] - image[next_m, k])
        values[j] = upper + v * (lower - upper)


@njit(cache=True, nogil=True)
def _sum_cells(cells: NDArray[np.float32], sums: NDArray[np.float32], per_sample: np.float32) -> None:
    """Write sums over neighbouring samples; one between two cells counts for both by its shares."""
    cells[:] = 0.0
    cell, room = 0, np.float32(1.0)
    for value in sums:
        share = min(room, per_sample)
        cells[cell] += share * value
        room -= share
        if room <= np.float32(1e-4) and cell + 1 < len(cells):
            cell += 1
            cells[cell] += (per_sample - share) * value
            room = np.float32(1.0) - (per_sample - share)


@njit(cache=True, nogil=True)
def _sum_gradients(
    descriptor: NDArray[np.float32], patch: NDArray[np.float32], weights: NDArray[np.float32]
) -> None:
    side = _SAMPLES // _CELLS
    descriptor[:] = 0.0
    for i in range(_SAMPLES):
        for j in range(_SAMPLES):
            falling = patch[i + 1, j + 1] - patch[i, j]
            rising = patch[i, j + 1] - patch[i + 1, j]
            weight = weights[i] * weights[j]
            dx, dy = weight * (falling + rising), weight * (falling - rising)
            k = 4 * (i // side * _CELLS + j // side)
            descriptor[k] += dx
            descriptor[k + 1] += dy
            descriptor[k + 2] += abs(dx)
            descriptor[k + 3] += abs(dy)
    squares = np.float32(0.0)
    for value in descriptor:
        squares += value * value
    if squares > 0.0:
        descriptor /= np.sqrt(squares)
