"""Depth noise of a log's camera, measured on the planes that a few of its frames show."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import ray_table
from mapper.core.geometry import Array
from mapper.runtime.ordered_map import ordered_map
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig
from mapper.sensing.planes import (
    LEAST_SIGMA_M,
    TILES_ACROSS,
    cut_tiles,
    distance_levels,
    fit_planes,
)
from mapper.sources.base import SPREAD_FRAMES, FrameRef, Log, read_depth

_STRIDE_PX = 2
_MIN_MEASURED_RATIO = 0.9
_MAX_NOISE_RATIO = 0.1
"""Twice what a plane may have elsewhere: a smaller limit would cut off the noise of far planes."""
_FLATTEST_PERCENT = 25.0
"""Relief only adds to the noise, so that of the flatter tiles is the sensor's."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredNoise:
    """Depth noise of a camera.

    Attributes:
        noise: Standard deviation of a depth, by depth.
        detail: Source of the noise; part of a sentence.
        depths_m: (N,) depths of some pixels, to count how many a limit leaves out.
    """

    noise: DepthNoiseConfig
    detail: str
    depths_m: Array

    def share_within(self, depth_m: float) -> float:
        """Return the share of depths up to a limit."""
        return float((self.depths_m <= depth_m).mean()) if len(self.depths_m) else 1.0


def measure_noise(source: Log, *, given: DepthNoiseConfig | None = None, workers: int) -> MeasuredNoise:
    """Measure a camera's depth noise, if the log does not state it; a Kinect's where too few planes are seen.

    Frames spread over the log are cut into tiles, and a plane is fitted to each. The tiles are sorted by
    distance, in steps of 10 %; the noise at a distance is the lower quartile of the standard deviations
    from the planes. It is taken to be σ_z = c·z² (Khoshelham & Elberink 2012, eq. 10), with the median of
    σ_z / z² over the farther half of the distances: a curve with more terms fits better where planes are
    seen, but does not extrapolate, and for sensors whose noise grows more slowly this errs on the safe side.

    Args:
        source: RGB-D log.
        given: The noise, where the user has set it; then only depths are collected.
        workers: Threads that decode frames.
    """
    entries = source.spread_entries(SPREAD_FRAMES)
    seen = [one for one in ordered_map(_seen, entries, workers=workers) if one is not None]
    depths_m = np.concatenate([np.empty(0), *(depths for depths, _, _ in seen)])
    if given is not None:
        return MeasuredNoise(given, "as set", depths_m)
    if source.depth_noise is not None:
        return MeasuredNoise(source.depth_noise, "that of stereo pairs", depths_m)
    distance_m = np.concatenate([np.empty(0), *(z for _, z, _ in seen)])
    sigma_m = np.concatenate([np.empty(0), *(sigmas for _, _, sigmas in seen)])
    frame_of = np.repeat(np.arange(len(seen), dtype=np.intp), [len(z) for _, z, _ in seen])
    distances_m, sigmas_m = _levels(distance_m, sigma_m, frame_of)
    if not len(distances_m):
        return MeasuredNoise(KINECT_NOISE, "that of a Kinect, as the log shows too few planes", depths_m)
    far = len(distances_m) // 2
    quadratic_per_m = float(f"{np.median(sigmas_m[far:] / distances_m[far:] ** 2):.3g}")
    return MeasuredNoise(
        DepthNoiseConfig(quadratic_per_m=max(quadratic_per_m, LEAST_SIGMA_M)),
        f"measured on planes {distances_m[0]:.1f} to {distances_m[-1]:.1f} m away",
        depths_m,
    )


def _seen(entry: FrameRef) -> tuple[Array, Array, Array] | None:
    """Return some depths of a frame, and the distances and standard deviations of tiles that are planes."""
    frame = read_depth(entry)
    if frame is None:
        return None
    depth_m = frame.depth_m[::_STRIDE_PX, ::_STRIDE_PX]
    some_m = depth_m[::4, ::4][depth_m[::4, ::4] > 0.0].astype(np.float64)
    side = max(depth_m.shape[1] // TILES_ACROSS, 3)
    tiles_m = cut_tiles(depth_m, side)
    measured = (tiles_m > 0.0).mean(axis=1) >= _MIN_MEASURED_RATIO
    if not measured.any():
        return some_m, np.empty(0), np.empty(0)
    tiles_m = tiles_m[measured]
    rays = cut_tiles(ray_table(frame.camera)[::_STRIDE_PX, ::_STRIDE_PX], side)[measured]
    planes = fit_planes(tiles_m, rays)
    distance_m = np.median(planes.depth_m, axis=1)
    flat = planes.explain(tiles_m > 0.0) & (planes.sigma_m <= _MAX_NOISE_RATIO * distance_m)
    return some_m, distance_m[flat], planes.sigma_m[flat]


def _levels(distance_m: Array, sigma_m: Array, frame_of: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the distances at which enough frames show enough planes, and the noise there."""
    levels = distance_levels(distance_m, frame_of)
    depths = [float(np.median(distance_m[level])) for level in levels]
    sigmas = [float(np.percentile(sigma_m[level], _FLATTEST_PERCENT)) for level in levels]
    return np.array(depths), np.array(sigmas)
