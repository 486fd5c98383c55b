"""A depth camera's noise from an ordinary log: whatever planes it happens to show, at whatever distance."""

from dataclasses import dataclass
from itertools import islice
from statistics import median

import numpy as np
from numpy.typing import NDArray

from mapper.errors import DataError, FrameError
from mapper.frames import RgbdFrame, ray_table
from mapper.geometry import Array
from mapper.parallel import ordered_map
from mapper.progress import SILENT, Progress
from mapper.sensing.depth_accuracy import (
    Accuracy,
    DepthLevel,
    Patch,
    ResidualMap,
    accuracy_of,
    depth_frame,
    first_frame,
    quantisation_step_m,
    typical,
)
from mapper.sensing.depth_filter import dif
from mapper.sensing.depth_planes import MAX_NOISE_RATIO, Planes, fit_planes
from mapper.sources.base import Entry, FrameSource

_TILES_ACROSS = 16
_BLOCKS = 5
"""A tile is so many blocks wide and high; what moves whole blocks is shape, not noise."""
_MIN_MEASURED_RATIO = 0.95
_MIN_PLANE_RATIO = 0.98
_MAX_TILT_RAD = np.radians(60.0)
"""Up to here a Kinect's axial noise does not depend on the angle (Nguyen et al. 2012, §4)."""
_MAX_SHAPE_RATIO = 0.6
_MAX_SHAPE_STEPS = 0.5
_BIN_RATIO = 1.1
_MIN_TILES, _MIN_FRAMES = 30, 3
_DECODERS = 2


@dataclass(frozen=True, slots=True)
class _Tile:
    """One plane that one frame showed."""

    frame: int
    distance_m: float
    tilt_rad: float
    measured_ratio: float
    raw: Accuracy
    filtered: Accuracy
    step_m: float | None


def depth_of_planes(
    source: FrameSource,
    *,
    patch: Patch | None = None,
    most_frames: int | None = None,
    progress: Progress = SILENT,
) -> tuple[list[DepthLevel], ResidualMap]:
    """Measure a camera by the planes that a log shows.

    Every frame is cut into tiles, a sixteenth of the image wide. A tile counts if a plane fits it: hardly
    anything lies far off, and what does lie off is noise from pixel to pixel rather than shape. Tiles are
    sorted by distance, in steps of 10 %, and every figure of a distance is the median over its tiles. As
    nobody knows where a plane really was, errors are those from the plane that was fitted, and what bends a
    whole tile is not seen.

    Args:
        source: RGB-D log.
        patch: Where in the image to look; None is everywhere.
        most_frames: About so many, evenly chosen, are enough; None takes all.
        progress: Told how far it is.

    Returns:
        The distances, from near to far, and the frame that shows most planes.

    Raises:
        DataError: The patch reaches beyond the image, or the log shows too few planes.
        SourceError: The log has no depth images that can be read.
    """
    first = first_frame(source)
    side = max(first.camera.width_px // (_TILES_ACROSS * _BLOCKS), 1) * _BLOCKS
    where = patch or Patch(0, 0, first.camera.width_px, first.camera.height_px)
    where.refuse_outside(first.camera)
    if min(where.width, where.height) < side:
        raise DataError(f"patch {where}: want at least one tile of {side}×{side} px")

    def look(numbered: tuple[int, Entry]) -> tuple[list[_Tile], ResidualMap] | None:
        number, entry = numbered
        try:
            return _tiles(depth_frame(entry), number, where, side)
        except FrameError:
            return None

    stride = 1 if most_frames is None else -(-len(source) // most_frames)
    chosen = len(range(0, len(source), stride))
    entries = islice(enumerate(source.entries()), None, None, stride)
    tiles: list[_Tile] = []
    best, most, unread = None, 0, 0
    with progress.stage("planes") as report:
        for done, found in enumerate(ordered_map(look, entries, workers=_DECODERS), start=1):
            if found is None:
                unread += 1
            else:
                tiles += found[0]
                if len(found[0]) > most:
                    best, most = found[1], len(found[0])
            report(done, chosen)
    if unread:
        progress.note(f"{source.path}: {unread} frames cannot be read")
    levels = _levels(source.name, tiles)
    if best is None or not levels:
        raise DataError(
            f"{source.path}: {len(tiles)} tiles of {chosen} frames show a plane, and no distance has "
            f"{_MIN_TILES} of {_MIN_FRAMES} frames; want walls, floors or tables in view"
        )
    return levels, best


def _tiles(frame: RgbdFrame, number: int, where: Patch, side: int) -> tuple[list[_Tile], ResidualMap]:
    """Return the tiles of a frame that show a plane, and a picture of them."""
    depth_m = _cut(frame.depth_m[where.slices], side)
    rays = _cut(ray_table(frame.camera)[where.slices], side)
    filtered_m = _cut(dif(frame.depth_m)[where.slices], side)
    whole = (depth_m > 0.0).mean(axis=1) >= _MIN_MEASURED_RATIO
    planes = fit_planes(depth_m[whole], rays[whole])
    steps_m = [quantisation_step_m(tile) for tile in depth_m[whole]]
    flat = _are_planes(planes, depth_m[whole], steps_m)
    at = np.flatnonzero(whole)
    tiles = [
        _Tile(
            frame=number,
            distance_m=float(np.median(planes.depth_m[k])),
            tilt_rad=float(planes.tilt_rad[k]),
            measured_ratio=float((depth_m[at[k]] > 0.0).mean()),
            raw=accuracy_of(depth_m[at[k]], planes.depth_m[k]),
            filtered=accuracy_of(filtered_m[at[k]], planes.depth_m[k]),
            step_m=steps_m[k],
        )
        for k in np.flatnonzero(flat)
    ]
    error_m = np.full(frame.depth_m.shape, np.nan)
    inside = error_m[where.slices]
    across = where.width // side
    for k in np.flatnonzero(flat):
        row, column = divmod(int(at[k]), across)
        miss_m = np.where(depth_m[at[k]] > 0.0, depth_m[at[k]] - planes.depth_m[k], np.nan)
        inside[row * side : (row + 1) * side, column * side : (column + 1) * side] = miss_m.reshape(
            side, side
        )
    return tiles, ResidualMap(frame.gray, error_m, f"frame {number}: {len(tiles)} tiles show a plane")


def _cut(image: NDArray[np.floating], side: int) -> Array:
    """Return (T, side², …) tiles of an (H, W, …) image, row by row; what is left at its ends is dropped."""
    rows, columns = image.shape[0] // side, image.shape[1] // side
    rest = image.shape[2:]
    whole = image[: rows * side, : columns * side].reshape(rows, side, columns, side, *rest)
    return whole.swapaxes(1, 2).reshape(rows * columns, side * side, *rest).astype(np.float64)


def _are_planes(planes: Planes, depth_m: Array, steps_m: list[float | None]) -> NDArray[np.bool_]:
    """Tell which tiles a plane explains up to noise."""
    measured = depth_m > 0.0
    share = planes.used.sum(axis=1) / np.maximum(measured.sum(axis=1), 1)
    shape_m = _shape_m(np.where(planes.used, depth_m - planes.depth_m, np.nan))
    step_m = np.array([0.0 if step is None else step for step in steps_m])
    flat: NDArray[np.bool_] = (
        (share >= _MIN_PLANE_RATIO)
        & (planes.tilt_rad <= _MAX_TILT_RAD)
        & (planes.sigma_m <= MAX_NOISE_RATIO * np.abs(planes.distance_m))
        & (shape_m <= np.maximum(_MAX_SHAPE_RATIO * planes.sigma_m, _MAX_SHAPE_STEPS * step_m))
    )
    return flat


def _shape_m(error_m: Array) -> Array:
    """Return (T,) standard deviation of the mean errors of a tile's blocks."""
    side = round(error_m.shape[1] ** 0.5)
    block = side // _BLOCKS
    blocks = error_m.reshape(len(error_m), _BLOCKS, block, _BLOCKS, block)
    known = ~np.isnan(blocks)
    count = known.sum(axis=(2, 4))
    means = np.where(known, blocks, 0.0).sum(axis=(2, 4)) / np.maximum(count, 1)
    return np.asarray(np.sqrt((means**2).mean(axis=(1, 2))))


def _levels(name: str, tiles: list[_Tile]) -> list[DepthLevel]:
    """Return the distances at which there are enough planes."""
    bins: dict[int, list[_Tile]] = {}
    for tile in tiles:
        bins.setdefault(int(np.floor(np.log(tile.distance_m) / np.log(_BIN_RATIO))), []).append(tile)
    levels = []
    for _, inside in sorted(bins.items()):
        frames = len({tile.frame for tile in inside})
        if len(inside) < _MIN_TILES or frames < _MIN_FRAMES:
            continue
        steps_m = [tile.step_m for tile in inside if tile.step_m is not None]
        levels.append(
            DepthLevel(
                name=name,
                distance_m=median(tile.distance_m for tile in inside),
                frames=frames,
                patches=len(inside),
                measured_ratio=median(tile.measured_ratio for tile in inside),
                tilt_rad=median(tile.tilt_rad for tile in inside),
                raw=typical([tile.raw for tile in inside]),
                filtered=typical([tile.filtered for tile in inside]),
                step_m=median(steps_m) if steps_m else None,
            )
        )
    return levels
