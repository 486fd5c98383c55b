"""Depth of image features, and its standard deviation."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import DepthImage
from mapper.core.geometry import Array
from mapper.sensing.config import DepthNoiseConfig
from mapper.sensing.depth_filter import dif


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
