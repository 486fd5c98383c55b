"""Levelling: up and the floor, which give the world frame of the maps."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Points, Transform, exp, stride_for, transform
from mapper.core.timebase import nearest
from mapper.core.trajectory import Trajectory
from mapper.mapping.body_axes import AXES, BodyAxes, mean_up
from mapper.mapping.config import LevelConfig
from mapper.mapping.floor_height import floor_below, floor_of, heights_of, weighed
from mapper.mapping.wall_direction import WallHeading, wall_heading
from mapper.registration.planes import (
    MAX_TILT_RAD,
    MIN_PATCHES,
    PARALLEL_RAD,
    Patches,
    Vertical,
    patches_of,
    vertical_of,
)
from mapper.registration.surfaces import prepared
from mapper.sources.base import Accelerations

_IN_LAYER = 1.0 / 3.0  # of a voxel
_MAX_READING_GAP_NS = 50_000_000
_MIN_READINGS = 50
_MAX_READINGS = 5000
_MAX_SPREAD_RAD = np.radians(20.0)
_CLEAR_SPREAD_RATIO = 1.25


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """The level frame.

    Attributes:
        T_level_world: (4, 4). In the level frame z points up and the floor is at z = 0; the first pose is at
            x = y = 0 and heads along +x, or up to 45° from it where x and y lie along walls.
        method: Source of the vertical: "accelerometer", "planes", "camera" or "laser plane".
        detail: Quality of the vertical, source of the floor and of x; a sentence for the manifest.
        has_floor: The floor was seen, or tf states its height; else this is a guess.
        conflict: Sentence on an accelerometer or a mounting that contradicts the up or the floor taken; else
            empty.
        is_decided: A floor below the sensor says which is right; true without a conflict.
    """

    T_level_world: Transform
    method: str
    detail: str
    has_floor: bool
    conflict: str = ""
    is_decided: bool = True


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
    held roughly upright. Of a LiDAR, the mounting and the axes of the accelerometer that the log states are
    weighed against it.

    Args:
        scans: Scans, spread over the log, with their T_world_body.
        trajectory: Poses of the body; at least one.
        accelerations: Readings, if there are any.
        config: Gives the tolerance of planes, and what x lies along.
        axes: Rough attitude of the sensor's body.

    Raises:
        DataError: The trajectory has no poses.
    """
    if not len(trajectory):
        raise DataError("levelling: the trajectory has no poses")
    tolerance_m = config.plane_tolerance_m
    rough = _rough_up(scans, trajectory, accelerations, config=config, axes=axes)
    up_guess = rough.up_world
    patches = patches_of(scans, tolerance_m=tolerance_m)
    up_world, method, up_detail = _up(
        patches, trajectory, accelerations, up_guess=up_guess, tolerance_m=tolerance_m
    )
    if axes.stands_on_floor:
        floor = floor_below(scans, up_world, tolerance_m=tolerance_m)
    else:
        heights_m = heights_of(scans, up_world)
        floor = floor_of(patches, heights_m, up_world=up_world, tolerance_m=tolerance_m)
    if axes.floor_world is not None:
        floor = weighed(floor, axes.floor_world @ up_world)
    T_level_world = _frame(trajectory.T_world_body[0], up_world, floor.height_m, axes)
    details = [up_detail, floor.detail]
    if config.heading == "walls":
        T_level_world, heading = _turned_along_walls(T_level_world, patches)
        details.append(heading)
    conflict = "; ".join(filter(None, [rough.conflict, floor.conflict]))
    return Level(T_level_world, method, "; ".join(details), floor.is_seen, conflict, rough.is_decided)


def level_in_plane(
    scans: Sequence[tuple[Scan, Transform]],
    *,
    trajectory: Trajectory,
    config: LevelConfig,
    axes: BodyAxes,
    resolution_m: float,
) -> Level:
    """Return the level frame of planar scans: up is the normal of their plane.

    The floor is the robot's footprint, or where the log states none, the robot's z = 0. A laser in or below
    that is taken to be on the floor. Its plane is a third of a voxel above the border of a layer, so that no
    rounding puts a scan into the layer below, at this resolution or at half of it.

    Args:
        scans: As for ``find_level``, planar.
        trajectory: Poses of the body.
        config: Says what x lies along.
        axes: Attitude of the body.
        resolution_m: Edge of a voxel of the map.

    Raises:
        DataError: The trajectory has no poses.
    """
    if not len(trajectory):
        raise DataError("levelling: the trajectory has no poses")
    T_world_first = trajectory.T_world_body[0]
    on_body_m = float(np.median([scan.origin_body[2] for scan, _ in scans])) if scans else 0.0
    laser_m = on_body_m
    if axes.floor_world is not None:
        laser_m += float((T_world_first[:3, 3] - axes.floor_world[0]) @ T_world_first[:3, 2])
    layer_m = (np.floor(max(laser_m, 0.0) / resolution_m + 1e-6) + _IN_LAYER) * resolution_m
    T_level_world = _frame(T_world_first, T_world_first[:3, 2], None, axes)
    T_level_world[2, 3] += layer_m - on_body_m
    stated = "as the log states" if laser_m > 0.0 else "as the log states no height of it"
    details = [f"up is the normal of the laser's plane, {max(laser_m, 0.0):.2f} m above the floor {stated}"]
    if config.heading == "walls":
        lines = [prepared(scan.points_body, voxel_m=2.0 * resolution_m, is_planar=True) for scan, _ in scans]
        normals_world = np.concatenate(
            [line.normals @ T[:3, :3].T for line, (_, T) in zip(lines, scans, strict=True)]
            or [np.empty((0, 3))]
        )
        normals_world = normals_world[normals_world.any(axis=1)]
        T_level_world, heading = _turned_along_walls(T_level_world, Patches(normals_world, normals_world))
        details.append(heading)
    return Level(T_level_world, "laser plane", "; ".join(details), has_floor=True)


@dataclass(frozen=True, slots=True, eq=False)
class _RoughUp:
    """Direction in the world within 60° of which up is; the rest as in ``Level``."""

    up_world: Array
    conflict: str = ""
    is_decided: bool = True


def _rough_up(
    scans: Sequence[tuple[Scan, Transform]],
    trajectory: Trajectory,
    accelerations: Accelerations | None,
    *,
    config: LevelConfig,
    axes: BodyAxes,
) -> _RoughUp:
    """Return up as tf mounts the sensor, as its accelerometer feels it, or along its z axis.

    The first of them that the log states is taken, or, where they contradict each other, the first below
    which a floor is seen: drivers turn the clouds of an inverted LiDAR, but may leave tf and accelerometer as
    they are.
    """
    up_sensor = axes.up_in(trajectory)
    if not axes.stands_on_floor:
        return _RoughUp(up_sensor)
    mounted = _Candidate("the mounting in tf" if axes.are_stated else "the sensor's z axis", up_sensor)
    candidates = [_Candidate("the accelerometer", up) for up in _felt(accelerations, trajectory)]
    candidates.insert(0 if axes.are_stated else len(candidates), mounted)
    if axes.are_stated:
        candidates.append(_Candidate("the sensor's z axis", mean_up(trajectory, AXES["lidar"].up)))
    chosen, is_decided = candidates[0], True
    if any(chosen.contradicts(other) for other in candidates):
        with_floor = [
            candidate
            for candidate in candidates
            if floor_below(scans, candidate.up_world, tolerance_m=config.plane_tolerance_m).is_seen
        ]
        chosen = next(iter(with_floor), chosen)
        is_decided = bool(with_floor) and not any(chosen.contradicts(other) for other in with_floor)
    if config.up != "auto" and len(candidates) > 1:
        wanted = mounted.name if config.up == "sensor" else "the accelerometer"
        chosen, is_decided = next((c for c in candidates if c.name == wanted), chosen), True
    stated = [mounted, *(candidate for candidate in candidates if candidate.name == "the accelerometer")]
    against = next((other for other in stated if chosen.contradicts(other)), None)
    if against is None:
        return _RoughUp(chosen.up_world)
    angle_deg = np.degrees(chosen.angle_to(against))
    doubt = "" if is_decided else " though no floor decides"
    conflict = (
        f"up by {against.name} is {angle_deg:.0f}° from up by {chosen.name}, which is taken{doubt}; "
        "level.up=sensor or level.up=accelerometer says which is right"
    )
    return _RoughUp(chosen.up_world, conflict, is_decided)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A direction in the world that something says is up."""

    name: str
    up_world: Array

    def angle_to(self, other: "_Candidate") -> float:
        return float(np.arccos(np.clip(self.up_world @ other.up_world, -1.0, 1.0)))

    def contradicts(self, other: "_Candidate") -> bool:
        return self.angle_to(other) > float(MAX_TILT_RAD)


def _felt(accelerations: Accelerations | None, trajectory: Trajectory) -> list[Array]:
    """Return up by an accelerometer in the axes that the log states; nothing where it is not clear."""
    if accelerations is None or not accelerations.are_axes_stated:
        return []
    readings, R_world_body = _matched_readings(accelerations, trajectory)
    if len(readings) < _MIN_READINGS:
        return []
    up_felt, spread_rad = _mean_direction(readings, R_world_body)
    return [up_felt] if spread_rad <= _MAX_SPREAD_RAD else []


def _mean_direction(readings: Array, R_world_body: Array) -> tuple[Array, float]:
    """Return the mean direction of (N, 3) readings in the world, and their RMS angle from it, rad."""
    directions_world = np.einsum("nij,nj->ni", R_world_body, readings)
    mean = directions_world.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    angles = np.arccos(np.clip(directions_world @ mean, -1.0, 1.0))
    return mean, float(np.sqrt(np.mean(angles**2)))


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
    if len(patches) >= MIN_PATCHES:
        vertical = vertical_of(patches, up_guess_world=up_guess, tolerance_m=tolerance_m)
        detail = _planes_text(vertical, len(patches))
        if vertical.is_agreed:
            return vertical.up_world, "planes", "; ".join([*details, detail])
        details.append(f"planes do not agree: {detail}")
    else:
        details.append(f"only {len(patches)} flat patches seen, want {MIN_PATCHES}")
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
        mean, spread_rad = _mean_direction(readings @ R_body_sensor.T, R_world_body)
        if mean @ up_guess > np.cos(MAX_TILT_RAD):
            found.append((spread_rad, mean))
    if not found:
        return None, "accelerometer: no axes put up within 60° of the camera's"
    found.sort(key=lambda one: one[0])
    spread_rad, up_world = found[0]
    if spread_rad > _MAX_SPREAD_RAD:
        return (
            None,
            f"accelerometer: readings spread over {np.degrees(spread_rad):.0f}°, at most 20° is usable",
        )
    others = [spread for spread, up in found if up @ up_world < np.cos(PARALLEL_RAD)]
    if others and others[0] < _CLEAR_SPREAD_RATIO * spread_rad:
        stated_up, stated_spread_rad = _mean_direction(readings, R_world_body)
        is_possible = stated_up @ up_guess > np.cos(MAX_TILT_RAD)
        if accelerations.are_axes_stated and is_possible and stated_spread_rad <= _MAX_SPREAD_RAD:
            detail = f"{len(readings)} accelerometer readings in the axes that the log states"
            return stated_up, f"{detail}, spread over {np.degrees(stated_spread_rad):.1f}°"
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


def _turned_along_walls(T_level_world: Transform, patches: Patches) -> tuple[Transform, str]:
    """Return the level frame with x along walls, if most agree, and a sentence on x."""
    walls = wall_heading(patches, T_level_world[:3, :3])
    if walls.determined:
        T_level_world = exp(np.array([0.0, 0.0, -walls.angle_rad]), np.zeros(3)) @ T_level_world
    return T_level_world, _heading_text(walls)


def _heading_text(walls: WallHeading) -> str:
    text = f"{100 * walls.agreeing_ratio:.0f} % of {walls.upright} upright patches agree on a heading"
    if not walls.determined:
        return f"x is the first pose's heading, since only {text}"
    return f"x lies along walls, {np.degrees(walls.angle_rad):.1f}° from the first pose's heading: {text}"
