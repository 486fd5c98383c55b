"""A depth camera's errors before a plane at a known distance (Somlyai, PhD thesis, §2.6) and on others."""

from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import RgbdFrame, ray_table
from mapper.core.geometry import Array
from mapper.evaluators.sensors.depth_accuracy import (
    DepthLevel,
    Patch,
    ResidualMap,
    SeenPlane,
    central_patch,
    depth_frame,
    first_frame,
    quantisation_step_m,
    seen_plane,
    typical_of,
)
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.depth import dif
from mapper.sensing.planes import (
    MAX_NOISE_RATIO,
    MIN_FRAMES,
    MIN_TILES,
    TILES_ACROSS,
    Planes,
    cut_tiles,
    distance_levels,
    fit_planes,
)
from mapper.sources.base import FrameRef, Log

_MIN_MEASURED_RATIO = 0.5
_MAX_TILT_RAD = np.radians(30.0)
_MAX_DISTANCE_RATIO = 0.2


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
        for done, result in enumerate(ordered_map(seen, source.entries()), start=1):
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


_BLOCKS = 5
"""Width and height of a tile in blocks; what moves whole blocks is shape, not noise."""
_MIN_TILE_MEASURED_RATIO = 0.95
_MAX_SHAPE_RATIO = 0.6
_MAX_SHAPE_STEPS = 0.5


def depth_of_planes(
    source: Log,
    *,
    patch: Patch | None = None,
    most_frames: int | None = None,
    progress: Progress = SILENT,
) -> tuple[list[DepthLevel], ResidualMap]:
    """Measure a camera by the planes that a log shows.

    Every frame is cut into tiles, a sixteenth of the image wide. A tile counts if a plane fits it: hardly
    anything lies far off, and what does lie off is noise from pixel to pixel rather than shape. Tiles are
    sorted by distance, in steps of 10 %, and every figure of a distance is the median over its tiles. As
    the true planes are unknown, errors are those from the fitted plane; what bends a whole tile is not seen.

    Args:
        source: RGB-D log.
        patch: Part of the image that is used; None is all.
        most_frames: Approximate number of frames, evenly chosen; None takes all.
        progress: Receives stages, counts and notes.

    Returns:
        The distances, from near to far, and the frame that shows most planes.

    Raises:
        DataError: The patch reaches beyond the image, or the log shows too few planes.
        SourceError: The log has no depth images that can be read.
    """
    first = first_frame(source)
    side = max(first.camera.width_px // (TILES_ACROSS * _BLOCKS), 1) * _BLOCKS
    where = patch or Patch(0, 0, first.camera.width_px, first.camera.height_px)
    where.check_inside(first.camera)
    if min(where.width, where.height) < side:
        raise DataError(f"patch {where}: want at least one tile of {side}×{side} px")

    def look(numbered: tuple[int, FrameRef]) -> tuple[int, list[SeenPlane], ResidualMap] | None:
        number, entry = numbered
        try:
            return number, *_planes(depth_frame(entry), where, side, number=number)
        except FrameError:
            return None

    stride = 1 if most_frames is None else -(-len(source) // most_frames)
    chosen = len(range(0, len(source), stride))
    entries = islice(enumerate(source.entries()), None, None, stride)
    planes: list[tuple[int, SeenPlane]] = []
    best, most, unread = None, 0, 0
    with progress.stage("planes") as report:
        for done, looked in enumerate(ordered_map(look, entries), start=1):
            if looked is None:
                unread += 1
            else:
                number, found, picture = looked
                planes += [(number, plane) for plane in found]
                if len(found) > most:
                    best, most = picture, len(found)
            report(done, chosen)
    if unread:
        progress.note(f"{source.path}: {unread} frames cannot be read")
    levels = _levels(source.name, planes)
    if best is None or not levels:
        raise DataError(
            f"{source.path}: {len(planes)} tiles of {chosen} frames show a plane, and no distance has "
            f"{MIN_TILES} of {MIN_FRAMES} frames; want walls, floors or tables in view"
        )
    return levels, best


def _planes(frame: RgbdFrame, where: Patch, side: int, *, number: int) -> tuple[list[SeenPlane], ResidualMap]:
    depth_m = cut_tiles(frame.depth_m[where.slices], side)
    rays = cut_tiles(ray_table(frame.camera)[where.slices], side)
    filtered_m = cut_tiles(dif(frame.depth_m)[where.slices], side)
    whole = np.flatnonzero((depth_m > 0.0).mean(axis=1) >= _MIN_TILE_MEASURED_RATIO)
    planes = fit_planes(depth_m[whole], rays[whole])
    steps_m = [quantisation_step_m(tile) for tile in depth_m[whole]]
    seen = []
    tiles_m = np.full(depth_m.shape, np.nan)
    for k in np.flatnonzero(_are_planes(planes, depth_m[whole], steps_m)):
        tile_m, on_plane_m = depth_m[whole[k]], planes.depth_m[k]
        tiles_m[whole[k]] = np.where(tile_m > 0.0, tile_m - on_plane_m, np.nan)
        seen.append(
            seen_plane(
                tile_m,
                filtered_m[whole[k]],
                on_plane_m,
                distance_m=float(np.median(on_plane_m)),
                tilt_rad=float(planes.tilt_rad[k]),
            )
        )
    error_m = np.full(frame.depth_m.shape, np.nan)
    together = _joined(tiles_m, side, across=where.width // side)
    error_m[where.slices][: together.shape[0], : together.shape[1]] = together
    return seen, ResidualMap(frame.gray, error_m, f"frame {number}: {len(seen)} tiles show a plane")


def _joined(tiles: Array, side: int, *, across: int) -> Array:
    return tiles.reshape(-1, across, side, side).swapaxes(1, 2).reshape(-1, across * side)


def _are_planes(planes: Planes, depth_m: Array, steps_m: list[float | None]) -> NDArray[np.bool_]:
    """Return (T,) which tiles a plane explains up to noise."""
    shape_m = _shape_m(np.where(planes.used, depth_m - planes.depth_m, np.nan))
    step_m = np.array([0.0 if step is None else step for step in steps_m])
    return (
        planes.explain(depth_m > 0.0)
        & (planes.sigma_m <= MAX_NOISE_RATIO * np.abs(planes.distance_m))
        & (shape_m <= np.maximum(_MAX_SHAPE_RATIO * planes.sigma_m, _MAX_SHAPE_STEPS * step_m))
    )


def _shape_m(error_m: Array) -> Array:
    """Return (T,) standard deviation of the mean errors of a tile's blocks."""
    side = round(error_m.shape[1] ** 0.5)
    block = side // _BLOCKS
    blocks = error_m.reshape(len(error_m), _BLOCKS, block, _BLOCKS, block)
    known = ~np.isnan(blocks)
    count = known.sum(axis=(2, 4))
    means = np.where(known, blocks, 0.0).sum(axis=(2, 4)) / np.maximum(count, 1)
    return np.asarray(np.sqrt((means**2).mean(axis=(1, 2))))


def _levels(name: str, planes: list[tuple[int, SeenPlane]]) -> list[DepthLevel]:
    frame_of = np.array([number for number, _ in planes], np.intp)
    distance_m = np.array([plane.distance_m for _, plane in planes])
    return [
        DepthLevel(
            name, len(np.unique(frame_of[level])), len(level), typical_of([planes[k][1] for k in level])
        )
        for level in distance_levels(distance_m, frame_of)
    ]
