"""Depth images: their filter, the depth of features and its noise, and which returns count as obstacles."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import DepthImage, Points32, Scan
from mapper.core.geometry import Array
from mapper.sensing.config import DepthNoiseConfig

_FARTHEST_M = 100.0
_FREE_SIGMAS = 2.0
"""A noisy return frees space up to this number of standard deviations before it."""


def dif(depth_m: DepthImage) -> DepthImage:
    """Return the mean of the measured pixels in the 3×3 neighbourhood of every pixel, itself included.

    Zeros are no measurements and do not enter the mean, so edges of holes keep their depth and holes one
    pixel deep are filled; a pixel with no measurement around it stays 0.

    Args:
        depth_m: (H, W) float32 depth, metres; 0 is no measurement. At the border, which the thesis does not
            define, the part of the neighbourhood inside the image is used.

    Raises:
        DataError: The image is not (H, W) float32.
    """
    if depth_m.ndim != 2 or depth_m.dtype != np.float32:
        raise DataError(f"DIF: depth image of {depth_m.dtype} {depth_m.shape}, want (H, W) float32")
    filtered = np.empty_like(depth_m)
    if depth_m.size:
        _mean_3x3(np.ascontiguousarray(depth_m), filtered)
    return filtered


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_3x3(depth_m: NDArray[np.float32], filtered: NDArray[np.float32]) -> None:
    """Sum columns of three first, then three columns: six additions per pixel instead of sixteen."""
    height, width = depth_m.shape
    # A column of zeros on either side is "not measured" beyond the border.
    sums = np.zeros(width + 2, np.float32)
    counts = np.zeros(width + 2, np.float32)
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        sums[1:-1] = 0.0
        counts[1:-1] = 0.0
        for row in range(above, below + 1):
            for x in range(width):
                sums[x + 1] += depth_m[row, x]
                counts[x + 1] += np.float32(depth_m[row, x] > 0.0)
        for x in range(width):
            count = counts[x] + counts[x + 1] + counts[x + 2]
            total = sums[x] + sums[x + 1] + sums[x + 2]
            filtered[y, x] = total / max(count, np.float32(1.0))


def depth_sigma_m(noise: DepthNoiseConfig, depth_m: Array) -> Array:
    """Return the standard deviations of depths, both in metres: σ_z = a + b·z + c·z²."""
    return noise.constant_m + depth_m * (noise.linear + depth_m * noise.quadratic_per_m)


def feature_depth_m(
    depth_m: DepthImage, pixels: NDArray[np.floating]
) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
    """Return (N,) depths of features, NaN without a measurement, and the (N,) columns and rows read.

    Args:
        depth_m: (H, W) depth image, registered to the raw image; 0 is no measurement.
        pixels: (N, 2) column and row in the raw image.
    """
    nearest = np.rint(pixels).astype(np.intp)
    columns, rows = (nearest[:, k].clip(0, depth_m.shape[1 - k] - 1) for k in (0, 1))
    z = depth_m[rows, columns].astype(np.float64)
    z[z <= 0.0] = np.nan
    return z, columns, rows


def feature_depth_sigma_m(
    depth_m: DepthImage,
    columns: NDArray[np.intp],
    rows: NDArray[np.intp],
    *,
    sigma_px: Array,
    noise: DepthNoiseConfig,
) -> Array:
    """Return (N,) standard deviations of the depths of features: the sensor's noise, and the slope.

    The depth is read at the detected pixel. Through the error of that pixel it is the depth of another point,
    and on a slope or next to an edge the difference exceeds the noise. The variation of the depth within one
    σ along either axis is taken from the image after DIF, so that noise is not counted twice.

    Args:
        depth_m: (H, W) depth image, 0 is no measurement.
        columns: (N,) pixels of the features.
        rows: (N,).
        sigma_px: (N,) standard deviation of a feature's pixel, along both axes.
        noise: Depth noise of the sensor.
    """
    smooth_m = dif(depth_m)
    height, width = depth_m.shape
    here_m = smooth_m[rows, columns].astype(np.float64)
    reach_px = np.maximum(np.rint(sigma_px), 1.0).astype(np.intp)
    squares = np.zeros(len(here_m))
    for across, down in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        row = np.clip(rows + down * reach_px, 0, height - 1)
        column = np.clip(columns + across * reach_px, 0, width - 1)
        there_m = smooth_m[row, column].astype(np.float64)
        squares += np.where(there_m > 0.0, (there_m - here_m) ** 2, 0.0)
    slope_m = np.sqrt(0.5 * squares) * sigma_px / reach_px  # mean of both sides of an axis; the axes add up
    return np.hypot(depth_sigma_m(noise, depth_m[rows, columns].astype(np.float64)), slope_m)


@dataclass(frozen=True, slots=True)
class DepthLimit:
    """Which returns of a depth camera count.

    Attributes:
        noise: Standard deviation σ(z) of the camera's depth.
        max_sigma_m: The largest with which a return counts as an obstacle.
    """

    noise: DepthNoiseConfig
    max_sigma_m: float

    @property
    def depth_m(self) -> float:
        """Least depth at which σ exceeds the limit, at most 100 m, which no depth camera reaches."""
        a, b, c = self.noise.constant_m - self.max_sigma_m, self.noise.linear, self.noise.quadratic_per_m
        if a >= 0.0:
            return 0.0
        if c == 0.0:
            return min(-a / b, _FARTHEST_M) if b > 0.0 else _FARTHEST_M
        return min((-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * c), _FARTHEST_M)

    def split(self, scan: Scan) -> tuple[Scan, Points32]:
        """Return the scan with the returns that count alone, and (M, 3) ends of rays that only free space.

        The ray of any other return frees space up to 2 σ before it, but not beyond ``depth_m``.

        Args:
            scan: Returns of a depth camera; z of the body is its optical axis.
        """
        limit_m = self.depth_m
        z = scan.points_body[:, 2] - np.float32(scan.origin_body[2])
        if not len(z) or z.max() <= limit_m:
            return scan, np.empty((0, 3), np.float32)
        near = z <= limit_m
        noise = self.noise.constant_m, self.noise.linear, self.noise.quadratic_per_m
        free_ends = _free_ends(scan.points_body, scan.origin_body, noise, limit_m)
        return scan.select(near), free_ends


@njit(cache=True, nogil=True)
def _free_ends(points, origin, noise, limit_m):
    """Return where the rays of returns beyond a depth stop to free space; some free none."""
    a, b, c = noise
    ends = np.empty((len(points), 3), np.float32)
    count = 0
    for i in range(len(points)):
        z = np.float64(points[i, 2]) - origin[2]
        if z <= limit_m:
            continue
        stop_m = min(z - _FREE_SIGMAS * (a + z * (b + z * c)), limit_m)
        if stop_m > 0.0:
            for axis in range(3):
                ends[count, axis] = origin[axis] + (points[i, axis] - origin[axis]) * (stop_m / z)
            count += 1
    return ends[:count].copy()
