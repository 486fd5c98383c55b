"""Accuracy of a depth camera from an ordinary log: by the planes that it happens to show."""

from itertools import islice

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import RgbdFrame, ray_table
from mapper.core.geometry import Array
from mapper.evaluators.depth_camera.accuracy import (
    DepthLevel,
    Patch,
    ResidualMap,
    SeenPlane,
    depth_frame,
    first_frame,
    quantisation_step_m,
    seen_plane,
    typical_of,
)
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.depth_filter import dif
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

_BLOCKS = 5
"""A tile is so many blocks wide and high; what moves whole blocks is shape, not noise."""
_MIN_MEASURED_RATIO = 0.95
_MAX_SHAPE_RATIO = 0.6
_MAX_SHAPE_STEPS = 0.5
_DECODERS = 2


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
        most_frames: About so many, evenly chosen, are enough; None takes all.
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
        for done, looked in enumerate(ordered_map(look, entries, workers=_DECODERS), start=1):
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
    """Return the planes that tiles of a frame show, and a picture of them."""
    depth_m = cut_tiles(frame.depth_m[where.slices], side)
    rays = cut_tiles(ray_table(frame.camera)[where.slices], side)
    filtered_m = cut_tiles(dif(frame.depth_m)[where.slices], side)
    whole = np.flatnonzero((depth_m > 0.0).mean(axis=1) >= _MIN_MEASURED_RATIO)
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
    """Return the image of (T, side²) tiles, so many across."""
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
    """Return the distances at which enough frames show enough planes."""
    frame_of = np.array([number for number, _ in planes], np.intp)
    distance_m = np.array([plane.distance_m for _, plane in planes])
    return [
        DepthLevel(
            name, len(np.unique(frame_of[level])), len(level), typical_of([planes[k][1] for k in level])
        )
        for level in distance_levels(distance_m, frame_of)
    ]
