"""Levelling: up and the floor, which give the world frame of the maps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import Scan, Sensor
from mapper.core.geometry import Array, Points, Transform, apply, exp, transform
from mapper.core.subsampling import stride_for
from mapper.core.timebase import nearest
from mapper.core.trajectory import Trajectory
from mapper.mapping.config import LevelConfig
from mapper.mapping.heading import WallHeading, wall_heading
from mapper.registration.planes import (
    Patches,
    Vertical,
    least_support,
    levels_of,
    patches_of,
    subsampled,
    vertical_of,
)
from mapper.sources.base import Accelerations


@dataclass(frozen=True, slots=True, eq=False)
class BodyAxes:
    """Rough attitude of a sensor's body.

    Attributes:
        up: (3,) unit vector that roughly points up, body frame.
        forward: (3,) unit vector along the body's heading, body frame.
        stands_on_floor: The floor is the surface below the sensor, not the lowest surface around: a street
            may fall away in range, and reflections lie below it.
    """

    up: Array
    forward: Array
    stands_on_floor: bool = False


AXES: Mapping[Sensor, BodyAxes] = {
    "rgbd": BodyAxes(up=np.array([0.0, -1.0, 0.0]), forward=np.array([0.0, 0.0, 1.0])),
    "lidar": BodyAxes(up=np.array([0.0, 0.0, 1.0]), forward=np.array([1.0, 0.0, 0.0]), stands_on_floor=True),
}


_MAX_READING_GAP_NS = 50_000_000
_MIN_READINGS = 50
_MAX_READINGS = 5000
_MAX_TILT_RAD = np.radians(60.0)
_MAX_SPREAD_RAD = np.radians(20.0)
_SAME_DIRECTION_RAD = np.radians(3.0)
_CLEAR_SPREAD_RATIO = 1.25

_MIN_PATCHES = 30
_FLAT_COSINE = np.cos(np.radians(10.0))
_NEAR_FLOOR_M = 0.15
_MAX_BELOW_FLOOR_RATIO = 0.01
_LOWEST_PERCENT = 0.5
_NEAR_SENSOR_M = 12.0
_MIN_SENSOR_HEIGHT_M = 0.15
_MIN_FLOOR_POINTS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """The level frame.

    Attributes:
        T_level_world: (4, 4). In the level frame z points up and the floor is at z = 0; the first pose is at
            x = y = 0 and heads along +x, or up to 45° from it where x and y lie along walls.
        method: Source of the vertical: "accelerometer", "planes" or "camera".
        detail: Quality of the vertical, source of the floor and of x; a sentence for the manifest.
        has_floor: The floor was seen; else its height is a guess.
    """

    T_level_world: Transform
    method: str
    detail: str
    has_floor: bool


def find_level(
    scans: Sequence[tuple[Scan, Transform]],
    *,
    trajectory: Trajectory,
    accelerations: Accelerations | None,
    config: LevelConfig,
    axes: BodyAxes,
) -> Level:
    """Return the level frame of a log.

    Up comes from the accelerometer if the log has one that is unambiguous, else from the planes in the scans,
    else from the mean of the body's own up direction. The first two lie within 60° of the last: a camera is
    held roughly upright.

    Args:
        scans: Scans, spread over the log, with their T_world_body.
        trajectory: Poses of the body; at least one.
        accelerations: Readings in the accelerometer's own axes, which may be a permutation of the body's.
        config: Gives the tolerance of planes, and what x lies along.
        axes: Rough attitude of the sensor's body.

    Raises:
        DataError: The trajectory has no poses.
    """
    if not len(trajectory):
        raise DataError("levelling: the trajectory has no poses")
    tolerance_m, up_guess = config.plane_tolerance_m, _mean_up(trajectory, axes.up)
    patches = patches_of(scans, tolerance_m=tolerance_m)
    up_world, method, up_detail = _up(
        patches, trajectory, accelerations, up_guess=up_guess, tolerance_m=tolerance_m
    )
    if axes.stands_on_floor:
        floor = _floor_below(scans, up_world, tolerance_m=tolerance_m)
    else:
        heights_m = _heights(scans, up_world)
        floor = _floor(patches, heights_m, up_world=up_world, tolerance_m=tolerance_m)
    T_level_world = _frame(trajectory.T_world_body[0], up_world, floor.height_m, axes)
    details = [up_detail, floor.detail]
    if config.heading == "walls":
        walls = wall_heading(patches, T_level_world[:3, :3])
        if walls.determined:
            T_level_world = exp(np.array([0.0, 0.0, -walls.angle_rad]), np.zeros(3)) @ T_level_world
        details.append(_heading_text(walls))
    return Level(T_level_world, method, "; ".join(details), floor.is_seen)


def _up(
    patches: Patches,
    trajectory: Trajectory,
    accelerations: Accelerations | None,
    *,
    up_guess: Array,
    tolerance_m: float,
) -> tuple[Array, str, str]:
    """Return up in the world, its method, and the detail for the manifest, refused methods included."""
    details = []
    if accelerations is not None:
        up_world, detail = _up_by_accelerometer(accelerations, trajectory, up_guess)
        if up_world is not None:
            return up_world, "accelerometer", detail
        details.append(detail)
    if len(patches) >= _MIN_PATCHES:
        vertical = vertical_of(patches, up_guess_world=up_guess, tolerance_m=tolerance_m)
        detail = _planes_text(vertical, len(patches))
        if vertical.is_agreed:
            return vertical.up_world, "planes", "; ".join([*details, detail])
        details.append(f"planes do not agree: {detail}")
    else:
        details.append(f"only {len(patches)} flat patches seen, want {_MIN_PATCHES}")
    return up_guess, "camera", "; ".join([*details, "up is the sensor's mean up direction"])


def _up_by_accelerometer(
    accelerations: Accelerations, trajectory: Trajectory, up_guess: Array
) -> tuple[Array | None, str]:
    """Return the mean direction of the readings in the world, or None, and the detail or the reason.

    The accelerometer's axes are one of the 24 right-angled frames; with the right one gravity keeps its
    direction in the world while the body turns.
    """
    readings, R_world_body = _matched_readings(accelerations, trajectory)
    if len(readings) < _MIN_READINGS:
        return None, f"accelerometer: only {len(readings)} readings near a pose, want {_MIN_READINGS}"
    found = []
    for R_body_sensor in _right_angled_frames():
        directions_world = np.einsum("nij,nj->ni", R_world_body, readings @ R_body_sensor.T)
        mean = directions_world.mean(axis=0)
        mean /= max(float(np.linalg.norm(mean)), 1e-12)
        if mean @ up_guess > np.cos(_MAX_TILT_RAD):
            angles = np.arccos(np.clip(directions_world @ mean, -1.0, 1.0))
            found.append((float(np.sqrt(np.mean(angles**2))), mean))
    if not found:
        return None, "accelerometer: no axes put up within 60° of the camera's"
    found.sort(key=lambda one: one[0])
    spread_rad, up_world = found[0]
    if spread_rad > _MAX_SPREAD_RAD:
        return (
            None,
            f"accelerometer: readings spread over {np.degrees(spread_rad):.0f}°, at most 20° is usable",
        )
    others = [spread for spread, up in found if up @ up_world < np.cos(_SAME_DIRECTION_RAD)]
    if others and others[0] < _CLEAR_SPREAD_RATIO * spread_rad:
        return None, "accelerometer: its axes are ambiguous because the body hardly turned"
    return up_world, f"{len(readings)} accelerometer readings spread over {np.degrees(spread_rad):.1f}°"


def _matched_readings(accelerations: Accelerations, trajectory: Trajectory) -> tuple[Array, Array]:
    """Return (N, 3) unit readings and the (N, 3, 3) rotation R_world_body at their time.

    Readings far from the median length are left out: the body accelerates.
    """
    stride = stride_for(len(accelerations.stamps_ns), _MAX_READINGS)
    stamps_ns = accelerations.stamps_ns[::stride]
    readings = accelerations.acceleration_mps2[::stride]
    lengths = np.linalg.norm(readings, axis=1)
    usable = np.isfinite(lengths) & (lengths > 0.0)
    if not usable.any():
        return np.empty((0, 3)), np.empty((0, 3, 3))
    median = np.median(lengths[usable])
    pose, gap_ns = nearest(trajectory.stamps_ns, stamps_ns)
    usable &= (np.abs(lengths - median) <= 0.2 * median) & (gap_ns <= _MAX_READING_GAP_NS)
    return readings[usable] / lengths[usable, None], trajectory.T_world_body[pose[usable], :3, :3]


def _right_angled_frames() -> list[Array]:
    """Return the 24 rotations that permute and flip axes."""
    frames = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), order] = signs
            if np.linalg.det(R) > 0.0:
                frames.append(R)
    return frames


def _mean_up(trajectory: Trajectory, up_body: Array) -> Array:
    """Return the mean of the body's up direction; the first one if the body turns over."""
    ups_world = trajectory.T_world_body[:, :3, :3] @ up_body
    mean: Array = ups_world.mean(axis=0)
    length = float(np.linalg.norm(mean))
    first: Array = ups_world[0]
    return mean / length if length > 0.3 else first


def _heights(scans: Sequence[tuple[Scan, Transform]], up_world: Array) -> Array:
    """Return (N,) heights along up of the points, metres."""
    heights = [apply(T_world_body, subsampled(scan)) @ up_world for scan, T_world_body in scans]
    return np.concatenate([np.empty(0), *heights])


@dataclass(frozen=True, slots=True)
class _Floor:
    """The floor.

    Attributes:
        height_m: Height along up; None is that of the first pose.
        detail: Source of the height; part of a sentence.
        is_seen: Whether a surface shows it; else it is a guess.
    """

    height_m: float | None
    detail: str
    is_seen: bool


def _floor(patches: Patches, heights_m: Array, *, up_world: Array, tolerance_m: float) -> _Floor:
    """Return the floor that patches show.

    The floor is the lowest surface that faces up with enough patches. If many points lie deeper, that surface
    is a table, and the lowest points give the floor.
    """
    if not len(heights_m):
        return _Floor(None, "no points seen: the floor is put at the first pose", is_seen=False)
    faces_up = patches.normals_world @ up_world > _FLAT_COSINE
    heights_up_m = patches.centres_world[faces_up] @ up_world
    surfaces = levels_of(heights_up_m, tolerance_m=tolerance_m, least=least_support(len(heights_up_m)))
    if surfaces:
        medians_m = np.array([np.median(heights_up_m[members]) for members in surfaces])
        # A surface has fringes just above and below it; the best supported of the lowest ones comes first.
        chosen = int(np.flatnonzero(medians_m <= medians_m.min() + _NEAR_FLOOR_M)[0])
        floor_m = float(medians_m[chosen])
        if (heights_m < floor_m - _NEAR_FLOOR_M).mean() <= _MAX_BELOW_FLOOR_RATIO:
            detail = f"floor seen in {len(surfaces[chosen])} of {len(patches)} patches"
            return _Floor(floor_m, detail, is_seen=True)
    lowest_m = float(np.percentile(heights_m, _LOWEST_PERCENT))
    detail = f"no floor seen: z = 0 is where the lowest {_LOWEST_PERCENT} % of the points end"
    return _Floor(lowest_m, detail, is_seen=False)


def _floor_below(scans: Sequence[tuple[Scan, Transform]], up_world: Array, *, tolerance_m: float) -> _Floor:
    """Return the floor below the first scan that shows one.

    It is the best supported height below the sensor among the points around it.
    """
    for scan, T_world_body in scans:
        sensor_world = apply(T_world_body, scan.origin_body[np.newaxis])[0]
        points_world = apply(T_world_body, scan.points_body.astype(np.float64)) - sensor_world
        heights_m = points_world @ up_world
        across_m = np.linalg.norm(points_world - heights_m[:, np.newaxis] * up_world, axis=1)
        below_m = heights_m[(across_m <= _NEAR_SENSOR_M) & (heights_m < -_MIN_SENSOR_HEIGHT_M)]
        least = max(_MIN_FLOOR_POINTS, len(below_m) // 4)
        levels = levels_of(below_m, tolerance_m=tolerance_m, least=least)
        if levels:
            floor_m = float(np.median(below_m[levels[0]]))
            height_m = floor_m + float(sensor_world @ up_world)
            return _Floor(height_m, f"floor {-floor_m:.2f} m below the sensor", is_seen=True)
    detail = "no floor seen below the sensor: the floor is put at the first pose"
    return _Floor(None, detail, is_seen=False)


def _frame(T_world_first: Transform, up_world: Array, floor_m: float | None, axes: BodyAxes) -> Transform:
    """Return T_level_world: z up, floor at 0, the first pose at x = y = 0 with its heading along +x.

    A body that faces straight down or up has no heading; its own up direction then gives +x.
    """
    R_world_first, first_world = T_world_first[:3, :3], T_world_first[:3, 3]
    heading = _flattened(R_world_first @ axes.forward, up_world)
    if np.linalg.norm(heading) < np.sin(np.radians(10.0)):
        heading = _flattened(R_world_first @ axes.up, up_world)
    x_world = heading / np.linalg.norm(heading)
    R_level_world = np.array([x_world, np.cross(up_world, x_world), up_world])
    first_level = R_level_world @ first_world
    height_m = first_level[2] if floor_m is None else floor_m
    return transform(R_level_world, -np.array([first_level[0], first_level[1], height_m]))


def _flattened(direction: Points, up_world: Array) -> Array:
    return direction - (direction @ up_world) * up_world


def _planes_text(vertical: Vertical, count: int) -> str:
    text = (
        f"of {count} flat patches {100 * vertical.horizontal_ratio:.0f} % are horizontal, "
        f"{100 * vertical.upright_ratio:.0f} % upright"
    )
    return text if vertical.determined else f"{text}, all facing one way: the tilt along them is the camera's"


def _heading_text(walls: WallHeading) -> str:
    text = f"{100 * walls.agreeing_ratio:.0f} % of {walls.upright} upright patches agree on a heading"
    if not walls.determined:
        return f"x is the first pose's heading, since only {text}"
    return f"x lies along walls, {np.degrees(walls.angle_rad):.1f}° from the first pose's heading: {text}"
