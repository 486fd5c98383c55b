"""The sensor's own vehicle: the box of returns that stand still while the sensor moves, and their removal."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapper.core.clusters import cluster_numbers
from mapper.core.errors import FrameError
from mapper.core.frames import Frame, RgbdFrame, Scan, Sensor
from mapper.core.geometry import Array, Points, Transform, apply
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import SPREAD_FRAMES, Log
from mapper.sources.config import BodyConfig, SourceConfig

Box = tuple[float, float, float, float, float, float]
"""Least x y z, then largest x y z, metres, body frame."""
_MIN_FRAMES = 8
_MIN_STANDING_RATIO, _SURE_RATIO, _MIN_SURE_CELLS = 0.6, 0.95, 2
"""Shares of the frames in which a cell of the vehicle has returns: at the edge of a driver who walks along,
and in the middle. With fewer of the latter a group is a wall that the sensor happens to keep beside."""
_MAX_STILL_WORLD_RATIO = 0.5
"""If more of the far cells stand still, so does the sensor, or it moves along a tunnel."""
_MAX_STEP_CELLS = 2
"""At most one empty cell lies between two members of a group."""
_LEVEL_CELLS, _CEILING_M = 2, 1.0
"""Height of a level layer above a LiDAR, and distance from which on it is a ceiling, which stands still."""
_MAX_RETURNS_RATIO = 0.3
"""What takes up more of the view is no vehicle: it is the object that is scanned."""
_MARGIN_M = 0.05


def clear_vehicle(log: Log, config: SourceConfig, *, progress: Progress = SILENT) -> tuple[Log, SourceConfig]:
    """Return a log without the returns of its own vehicle, and its settings with the box that was found.

    Both are returned as they are where the settings have a box or want none, or no vehicle is seen.
    """
    box = vehicle_box(log) if config.body.finds_box else None
    if box is None:
        return log, config
    body = BodyConfig(box=box)
    numbers = ",".join(f"{value:g}" for value in box)
    note = (
        f"returns that stay in place near the sensor are left out, as its own vehicle's: "
        f"source.body.box=[{numbers}]; source.body.find_box=false keeps them"
    )
    progress.note(note)
    cleared = replace(without_vehicle(log, body), notes=[*log.notes, note])
    return cleared, config.model_copy(update={"body": config.body.model_copy(update={"box": box})})


def without_vehicle(log: Log, config: BodyConfig) -> Log:
    """Return a log whose frames, and those beside it, have no returns of the sensor's own vehicle."""

    def cleared(one: Log, T_body_sensor: Transform) -> Log:
        return one.with_frames(partial(_clear, config=config, T_body_sensor=T_body_sensor))

    beside = [replace(one, log=cleared(one.log, one.T_body_sensor)) for one in log.beside]
    return replace(cleared(log, np.eye(4)), beside=beside)


def _clear(frame: Frame, *, config: BodyConfig, T_body_sensor: Transform) -> Frame:
    """Return a frame without the returns of the vehicle; its depth is 0 there, as where nothing was measured.

    Args:
        frame: The frame, or its returns alone.
        config: What is left out; the box is in the body.
        T_body_sensor: (4, 4) pose of the frame's points.

    Raises:
        FrameError: No return of a scan is left.
    """
    kept = _are_of_the_world(frame.scan(), config, T_body_sensor)
    if kept.all():
        return frame
    if isinstance(frame, RgbdFrame):
        depth_m = frame.depth_m.copy()
        depth_m[depth_m > 0.0] *= kept  # a scan has the measured pixels, row by row
        return replace(frame, depth_m=depth_m)
    if not kept.any():
        raise FrameError(
            f"frame {frame.stamp_ns}: all {len(kept)} returns are of the vehicle or out of range "
            "(source.body.box, min_range_m, max_range_m)"
        )
    return frame.select(kept)


def _are_of_the_world(scan: Scan, config: BodyConfig, T_body_sensor: Transform) -> NDArray[np.bool_]:
    """Return the (N,) mask of the returns that are not of the vehicle, and in range."""
    points = scan.points_body
    kept = np.ones(len(points), np.bool_)
    if config.box is not None:
        is_body = np.array_equal(T_body_sensor, np.eye(4))
        points_body = points if is_body else apply(T_body_sensor, points.astype(np.float64))
        lower, upper = np.array(config.box, np.float32).reshape(2, 3)
        inside = np.ones(len(points), np.bool_)
        for axis in range(3):
            inside &= (points_body[:, axis] >= lower[axis]) & (points_body[:, axis] <= upper[axis])
        kept &= ~inside
    if config.min_range_m > 0.0 or config.max_range_m is not None:
        range_m = np.linalg.norm(points - scan.origin_body.astype(np.float32), axis=1)
        kept &= (range_m >= config.min_range_m) & (range_m <= (config.max_range_m or np.inf))
    return kept


@dataclass(frozen=True, slots=True)
class _Scale:
    """Size of a vehicle around a kind of sensor.

    Attributes:
        cell_m: Edge of the cells that returns are counted in.
        vehicle_m: The vehicle is within this distance.
        around_m: Returns up to here are used to distinguish walls that stand beside it.
        ground_m: Height up to which returns are the ground's; None where up is not known.
        step: One of this number of returns is counted.
    """

    cell_m: float
    vehicle_m: float
    around_m: float
    ground_m: float | None
    step: int


_SCALES: Mapping[Sensor, _Scale] = {
    "lidar": _Scale(cell_m=0.25, vehicle_m=4.0, around_m=12.0, ground_m=0.3, step=1),
    "rgbd": _Scale(cell_m=0.05, vehicle_m=1.0, around_m=3.0, ground_m=None, step=8),
    "lidar-2d": _Scale(cell_m=0.05, vehicle_m=1.0, around_m=3.0, ground_m=None, step=1),
}


def vehicle_box(log: Log) -> Box | None:
    """Return a box around the vehicle that carries a log's sensor, and a driver beside it; None without.

    Returns near the sensor are counted in cells of the body frame, over frames spread over the log. Cells
    that have returns in most of them are the vehicle, unless they join others that lie farther off, as
    those of walls along the way do. Ground below a LiDAR stands still too, and is left out by its height.
    """
    scale = _SCALES[log.sensor]
    clouds, returns = _clouds(log, scale)
    if len(clouds) < _MIN_FRAMES:
        return None
    cells, standing = _counted(clouds, scale)
    range_m = np.linalg.norm((cells + 0.5) * scale.cell_m, axis=1)
    still = standing >= _MIN_STANDING_RATIO
    far = range_m > scale.vehicle_m
    world = still[far & (standing >= 2.0 / len(clouds))]
    if not far.any() or (len(world) and world.mean() > _MAX_STILL_WORLD_RATIO):
        return None
    cells, standing, range_m = cells[still], standing[still], range_m[still]
    group_of = cluster_numbers(cells, _MAX_STEP_CELLS, norm=np.inf)
    groups = [group_of == number for number in range(group_of.max(initial=-1) + 1)]
    own = [one for one in groups if _is_vehicle(cells[one], standing[one], range_m[one], scale)]
    own_cells = cells[np.any(own, axis=0)] if own else cells[:0]
    if not len(own_cells):
        return None
    lower = own_cells.min(axis=0) * scale.cell_m - _MARGIN_M
    upper = (own_cells.max(axis=0) + 1) * scale.cell_m + _MARGIN_M
    inside = sum(int(((points >= lower) & (points <= upper)).all(axis=1).sum()) for points in clouds)
    if inside > _MAX_RETURNS_RATIO * returns:
        return None
    x_low, y_low, z_low, x_high, y_high, z_high = (round(float(v), 3) for v in (*lower, *upper))
    return x_low, y_low, z_low, x_high, y_high, z_high


def _is_vehicle(cells: NDArray[np.int64], standing: Array, range_m: Array, scale: _Scale) -> bool:
    """Return whether a group of cells is near, stands for sure, and is no ceiling seen in a few rings."""
    is_sure = (standing >= _SURE_RATIO).sum() >= _MIN_SURE_CELLS and range_m.max() <= scale.vehicle_m
    is_level = np.ptp(cells[:, 2]) < _LEVEL_CELLS and cells[:, 2].min() >= 0
    is_ceiling = scale.ground_m is not None and is_level and range_m.min() >= _CEILING_M
    return bool(is_sure and not is_ceiling)


def _clouds(log: Log, scale: _Scale) -> tuple[list[Points], int]:
    """Return the points around the sensor of some frames, without the ground, and the number of all."""
    clouds: list[Points] = []
    returns = 0
    for entry in log.spread_entries(SPREAD_FRAMES):
        try:
            points = entry.scan().points_body[:: scale.step]
        except FrameError:
            continue
        returns += len(points)
        is_around = np.einsum("nk,nk->n", points, points) <= scale.around_m**2
        clouds.append(points[is_around].astype(np.float64))
    if scale.ground_m is not None and clouds:
        limit_m = _ground_m(np.concatenate([points[:, 2] for points in clouds])) + scale.ground_m
        clouds = [points[points[:, 2] > limit_m] for points in clouds]
    return clouds, returns


def _ground_m(heights_m: Array) -> float:
    """Return the height below the sensor at which most returns lie."""
    below_m = heights_m[heights_m < 0.0]
    if not len(below_m):
        return -np.inf
    counts, edges_m = np.histogram(below_m, bins=np.arange(np.floor(below_m.min()), 0.15, 0.1))
    return float(edges_m[int(counts.argmax())]) + 0.05


def _counted(clouds: list[Points], scale: _Scale) -> tuple[NDArray[np.int64], Array]:
    """Return the (C, 3) cells with returns, and the share of the clouds that have some in each."""
    reach = int(scale.around_m / scale.cell_m) + 1
    counts = np.zeros((2 * reach + 1,) * 3, np.int64)
    for points in clouds:
        seen = np.zeros(counts.shape, np.bool_)
        seen[tuple((np.floor(points / scale.cell_m).astype(np.int64) + reach).T)] = True
        counts += seen
    return np.argwhere(counts) - reach, counts[counts > 0] / len(clouds)
