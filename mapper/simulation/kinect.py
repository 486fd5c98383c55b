"""Sensor model of a Kinect v1: noisy, quantised, incomplete depth and grainy colour from an exact image."""

import math
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import DepthImage, Image
from mapper.simulation.config import SensorConfig, SynthConfig
from mapper.simulation.noise import Field32, fractal
from mapper.simulation.raycast import Rendering
from mapper.simulation.streams import Stream, rng_of

BASELINE_M = 0.075
"""Between projector and infrared camera (Khoshelham & Elberink 2012)."""
DISPARITY_FOCAL_PX = 580.0
"""Focal length of the infrared camera, in whose pixels disparities are counted whatever our image's size."""

_PATCH_PX_AT_640 = 9.0
_GRAZING_COSINE, _GRAZING_SPREAD = 0.16, 0.06
_EDGE_RATIO, _EDGE_CHANCE = 0.04, 0.35
_SPECKLE_CHANCE = 0.001
_TINY_M = np.float32(1e-3)


def observe(
    rendering: Rendering,
    *,
    focal_px: float,
    sensor: SensorConfig,
    rng: np.random.Generator,
    warp_px: Field32 | None = None,
) -> tuple[Image, DepthImage]:
    """Return the (H, W, 3) uint8 colour and (H, W) float32 depth in metres that the sensor reports.

    Lost depth is 0.

    Args:
        rendering: The exact image.
        focal_px: Focal length of the rendering.
        sensor: Settings of the sensor.
        rng: This frame's own noise.
        warp_px: (H, W) constant error of the disparity; None is none.
    """
    image_rng, depth_rng, loss_rng = rng.spawn(3)
    image = _grainy(rendering.rgb, sensor.image_noise_levels, image_rng)
    measured_m = rendering.depth_m if warp_px is None else _warped(rendering.depth_m, warp_px)
    depth_m = _noisy_depth(measured_m, sensor, depth_rng)
    if sensor.depth_scale != 1.0:
        depth_m *= np.float32(sensor.depth_scale)
    lost = _out_of_range(rendering.depth_m, sensor, loss_rng)
    if sensor.dropout_ratio > 0.0:
        lost |= _unseen(rendering, focal_px, sensor.dropout_ratio, loss_rng)
    depth_m[lost] = 0.0
    return image, depth_m


def warp_of(config: SynthConfig) -> Field32:
    """Return the (H, W) constant error of a camera's disparity, pixels at 640 px across."""
    shape = (config.height_px, config.width_px)
    cell_px = (shape[0] / 3.0, shape[1] / 4.0)
    smooth = fractal(rng_of(config.seed, Stream.WARP), shape, cell_px=cell_px, octaves=2)
    return np.float32(config.sensor.disparity_warp_px) * smooth


def axial_sigma_m(depth_m: NDArray[np.floating]) -> Field32:
    """Return the standard deviation of a Kinect's depth at a depth in metres (Nguyen et al. 2012, eq. 3)."""
    sigma_m = 0.0012 + 0.0019 * (np.maximum(depth_m, 0.4) - 0.4) ** 2
    return np.asarray(sigma_m, dtype=np.float32)


def _grainy(rgb: Image, levels: float, rng: np.random.Generator) -> Image:
    if levels == 0.0:
        return rgb
    grain = _whole_normals(rng, rgb.shape, sigma=levels)
    return np.asarray(cv2.add(rgb, grain, dtype=cv2.CV_8U), dtype=np.uint8)


def _whole_normals(rng: np.random.Generator, shape: tuple[int, ...], *, sigma: float) -> NDArray[np.int16]:
    """Return normal numbers rounded to integers, ten times as fast as by drawing floats.

    A random byte picks one of the distribution's 256 quantiles.
    """
    quantiles = [NormalDist(0.0, sigma).inv_cdf((k + 0.5) / 256.0) for k in range(256)]
    picks = np.frombuffer(rng.bytes(math.prod(shape)), dtype=np.uint8)
    return np.rint(quantiles).astype(np.int16)[picks].reshape(shape)


def _warped(depth_m: DepthImage, warp_px: Field32) -> DepthImage:
    """Return depths whose disparities are wrong by these errors (Herrera et al. 2012, eq. 5)."""
    inverse_m = 1.0 / np.maximum(depth_m, _TINY_M) + warp_px / np.float32(BASELINE_M * DISPARITY_FOCAL_PX)
    return np.asarray(1.0 / np.maximum(inverse_m, _TINY_M), dtype=np.float32)


def _noisy_depth(depth_m: DepthImage, sensor: SensorConfig, rng: np.random.Generator) -> DepthImage:
    """Displace, add axial and disparity noise, then round to whole disparity steps."""
    measured: DepthImage = _displaced(depth_m, sensor.lateral_noise_px, rng)
    if sensor.axial_noise_ratio > 0.0:
        noise = _in_pixels_and_patches(depth_m.shape, rng)
        noise *= np.float32(math.sqrt(0.5) * sensor.axial_noise_ratio) * axial_sigma_m(measured)
        measured = measured + noise
    if sensor.disparity_noise_px > 0.0:
        noise = _in_pixels_and_patches(depth_m.shape, rng)
        measured = _warped(measured, np.float32(math.sqrt(0.5) * sensor.disparity_noise_px) * noise)
    if sensor.disparity_step_px > 0.0:
        one_step_m = np.float32(BASELINE_M * DISPARITY_FOCAL_PX / sensor.disparity_step_px)
        steps = np.maximum(np.rint(one_step_m / np.maximum(measured, _TINY_M)), np.float32(1.0))
        measured = np.asarray(one_step_m / steps, dtype=np.float32)
    return measured.copy()


def _displaced(depth_m: DepthImage, sigma_px: float, rng: np.random.Generator) -> DepthImage:
    """Return each pixel's depth as measured a random fraction of a pixel beside it (Handa et al. 2014)."""
    if sigma_px == 0.0:
        return depth_m
    height, width = depth_m.shape
    shift = _whole_normals(rng, (2, height, width), sigma=sigma_px)
    rows = np.clip(np.arange(height, dtype=np.int32)[:, None] + shift[0], 0, height - 1)
    columns = np.clip(np.arange(width, dtype=np.int32) + shift[1], 0, width - 1)
    displaced: DepthImage = np.take(depth_m, rows * width + columns)
    return displaced


def _in_pixels_and_patches(shape: tuple[int, ...], rng: np.random.Generator) -> Field32:
    """Return (H, W) noise of variance 2, half of it from pixel to pixel and half in patches."""
    return rng.standard_normal(shape, dtype=np.float32) + _patches(shape, rng)


def _patches(shape: tuple[int, ...], rng: np.random.Generator) -> Field32:
    """Return smooth (H, W) noise of standard deviation 1, as the correlation window leaves it."""
    height, width = shape
    patch_px = max(_PATCH_PX_AT_640 * width / 640.0, 1.0)
    grid = rng.standard_normal((int(height / patch_px) + 2, int(width / patch_px) + 2), dtype=np.float32)
    smooth = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(smooth / smooth.std(), dtype=np.float32)


def _out_of_range(depth_m: DepthImage, sensor: SensorConfig, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return the pixels without a return: too near, too far, and ever more in between."""
    near, far = max(sensor.min_depth_m, 1e-6), sensor.max_depth_m
    lost: NDArray[np.bool_] = (depth_m < near) | (depth_m > far)
    if far > sensor.fade_depth_m:
        chance = (depth_m - sensor.fade_depth_m) / (far - sensor.fade_depth_m)
        uneven = np.float32(0.5) + np.float32(0.25) * _patches(depth_m.shape, rng)
        lost |= uneven + rng.uniform(-0.1, 0.1, depth_m.shape) < chance
    return lost


def _unseen(
    rendering: Rendering, focal_px: float, dropout_ratio: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return the pixels where the pattern is not found: in shadow, at a slant, at edges, some at random."""
    depth_m = rendering.depth_m
    chance = np.where(_in_shadow(depth_m, focal_px), np.float32(1.0), np.float32(_SPECKLE_CHANCE))
    ragged = np.float32(_GRAZING_COSINE) + np.float32(_GRAZING_SPREAD) * _patches(depth_m.shape, rng)
    chance[rendering.cosine < ragged] = 1.0
    near = cv2.erode(depth_m, np.ones((3, 3), dtype=np.uint8))
    edge = depth_m - near > _EDGE_RATIO * depth_m
    chance[edge] = np.maximum(chance[edge], np.float32(_EDGE_CHANCE))
    draws = rng.random(depth_m.shape, dtype=np.float32)
    return draws < np.float32(dropout_ratio) * chance


def _in_shadow(depth_m: DepthImage, focal_px: float) -> NDArray[np.bool_]:
    """Return which pixels the projector, a baseline to the camera's right, cannot light.

    Seen from the projector a pixel of depth z lies f · b / z further left. Where something further right
    in the image ends up at the same place or left of it, that something is nearer and takes the light.
    """
    disparity_px = np.float32(focal_px * BASELINE_M) / np.maximum(depth_m, np.float32(0.05))
    seen_at = np.arange(depth_m.shape[1], dtype=np.float32) - disparity_px
    leftmost = np.minimum.accumulate(seen_at[:, ::-1], axis=1)[:, ::-1]
    return seen_at > leftmost + 0.5
