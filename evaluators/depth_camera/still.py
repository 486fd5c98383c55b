"""A depth camera that stands still before a plane at a known distance (Somlyai, PhD thesis, §2.6)."""

from dataclasses import replace

import numpy as np

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import RgbdFrame, ray_table
from mapper.core.geometry import Array
from mapper.evaluators.depth_camera.accuracy import (
    DepthLevel,
    Patch,
    ResidualMap,
    SeenPlane,
    central_patch,
    depth_frame,
    first_frame,
    seen_plane,
    typical_of,
)
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.depth_filter import dif
from mapper.sensing.planes import MAX_NOISE_RATIO, fit_planes
from mapper.sources.base import FrameRef, Log

_MIN_MEASURED_RATIO = 0.5
_MAX_TILT_RAD = np.radians(30.0)
_MAX_DISTANCE_RATIO = 0.2
_DECODERS = 2


class _Pixels:
    """Mean and variance of each pixel over the frames, from sums: errors are small, so nothing cancels."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._count, self._sum, self._squares = np.zeros(shape), np.zeros(shape), np.zeros(shape)

    def add(self, error_m: Array) -> None:
        """Take in one frame's (H, W) errors, NaN where there is none."""
        known = ~np.isnan(error_m)
        error_m = np.where(known, error_m, 0.0)
        self._count += known
        self._sum += error_m
        self._squares += error_m**2

    @property
    def mean_m(self) -> Array:
        """(H, W) mean error, NaN where nothing was ever measured."""
        mean: Array = np.divide(
            self._sum, self._count, out=np.full(self._sum.shape, np.nan), where=self._count > 0
        )
        return mean

    def noise_m(self) -> tuple[float, float] | tuple[None, None]:
        """Return the standard deviation over time, and of what stays; None of pixels seen only once.

        The variance of the means is less by what of the first is left in them.
        """
        often = self._count > 1
        if not often.any():
            return None, None
        count, mean_m = self._count[often], self.mean_m[often]
        variance = np.maximum(self._squares[often] - count * mean_m**2, 0.0) / (count - 1)
        temporal, left = float(variance.mean()), float((variance / count).mean())
        return temporal**0.5, max(float(mean_m.var()) - left, 0.0) ** 0.5


def depth_at(
    source: Log,
    distance_m: float,
    *,
    patch: Patch | None = None,
    keep_tilt: bool = False,
    progress: Progress = SILENT,
) -> tuple[DepthLevel, ResidualMap]:
    """Measure a camera that stands still in front of a plane at a known distance.

    Every figure is the median over the frames. Unless ``keep_tilt``, the plane that depths are compared with
    is tilted as they show it, and goes through ``distance_m`` on the optical axis: a degree off the
    perpendicular moves the ends of a patch by more than their noise. Noise over time is that of each pixel's
    distance from its frame's plane, so a camera that creeps along its axis does not add to it.

    Args:
        source: RGB-D log.
        distance_m: Depth of the plane where the optical axis meets it.
        patch: Part of the image that shows only the plane; None is the middle third of the image, each way.
        keep_tilt: Compare with a plane across the axis, as the thesis does.
        progress: Receives notes of frames that show no plane.

    Raises:
        DataError: The patch reaches beyond the image, no frame shows a plane there, or it is elsewhere.
        SourceError: The log has no depth images that can be read.
    """
    first = first_frame(source)
    where = central_patch(first.camera) if patch is None else patch
    where.check_inside(first.camera)

    def seen(entry: FrameRef) -> tuple[SeenPlane, Array] | str:
        try:
            return _see(depth_frame(entry), distance_m, where, keep_tilt=keep_tilt)
        except (DataError, FrameError) as error:
            return str(error)

    pixels = _Pixels((where.height, where.width))
    planes: list[SeenPlane] = []
    reasons: list[str] = []
    with progress.stage(f"{distance_m:g} m") as report:
        for done, result in enumerate(ordered_map(seen, source.entries(), workers=_DECODERS), start=1):
            if isinstance(result, str):
                reasons.append(result)
            else:
                planes.append(result[0])
                pixels.add(result[1])
            report(done, len(source))
    if not planes:
        raise DataError(
            f"{source.path}: none of {len(reasons)} frames shows a plane; the first: {reasons[0]}"
        )
    if reasons:
        progress.note(f"{source.path}: {len(reasons)} frames left out; the first: {reasons[0]}")
    typical = typical_of(planes)
    _check_distance(source, typical.distance_m, distance_m)
    error_m = np.full(first.depth_m.shape, np.nan)
    error_m[where.slices] = pixels.mean_m
    caption = f"{distance_m:g} m, mean of {len(planes)} frames"
    level = DepthLevel(
        source.name, len(planes), len(planes), replace(typical, distance_m=distance_m), *pixels.noise_m()
    )
    return level, ResidualMap(first.gray, error_m, caption)


def _see(frame: RgbdFrame, distance_m: float, patch: Patch, *, keep_tilt: bool) -> tuple[SeenPlane, Array]:
    """Return the plane in one frame's patch, and each pixel's error from it, NaN without depth.

    Raises:
        DataError: It shows no plane.
    """
    depth_m = frame.depth_m[patch.slices].astype(np.float64)
    measured = depth_m > 0.0
    if measured.mean() < _MIN_MEASURED_RATIO:
        raise DataError(
            f"frame {frame.stamp_ns}: {measured.mean():.0%} of the patch {patch} has depth, "
            f"want at least {_MIN_MEASURED_RATIO:.0%}"
        )
    rays = ray_table(frame.camera)[patch.slices].astype(np.float64)
    plane = fit_planes(depth_m.reshape(1, -1), rays.reshape(1, -1, 2))
    sigma_ratio = float(plane.sigma_m[0] / abs(plane.distance_m[0]))
    if sigma_ratio > MAX_NOISE_RATIO:
        raise DataError(
            f"frame {frame.stamp_ns}: depths in the patch {patch} lie {sigma_ratio:.0%} off any plane, "
            f"want at most {MAX_NOISE_RATIO:.0%}"
        )
    if plane.tilt_rad[0] > _MAX_TILT_RAD:
        raise DataError(
            f"frame {frame.stamp_ns}: the plane in the patch {patch} is {np.degrees(plane.tilt_rad[0]):.0f}° "
            f"from lying across the camera's axis, want at most {np.degrees(_MAX_TILT_RAD):.0f}°"
        )
    on_plane_m = plane.depth_m.reshape(depth_m.shape)
    reference_m = distance_m if keep_tilt else on_plane_m * (distance_m / plane.distance_m[0])
    seen = seen_plane(
        depth_m,
        dif(frame.depth_m)[patch.slices].astype(np.float64),
        reference_m,
        distance_m=float(plane.distance_m[0]),
        tilt_rad=float(plane.tilt_rad[0]),
    )
    return seen, np.where(measured, depth_m - on_plane_m, np.nan)


def _check_distance(source: Log, shown_m: float, distance_m: float) -> None:
    if abs(shown_m - distance_m) > _MAX_DISTANCE_RATIO * distance_m:
        raise DataError(
            f"{source.path}: shows a plane at {shown_m:.3g} m, not at {distance_m:g} m; are the distances "
            "in the order of the logs, and the log's depth units right (source.camera.depth_factor)?"
        )
