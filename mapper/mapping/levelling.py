"""Levelling: up and the floor, which give the world frame of the maps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Points, Transform, exp, transform
from mapper.core.trajectory import Trajectory
from mapper.mapping.body_axes import AXES, BodyAxes, mean_up
from mapper.mapping.config import LevelConfig
from mapper.mapping.floor_height import floor_below, floor_of, heights_of, weighed
from mapper.mapping.gravity import up_by_accelerometer, up_in_stated_axes
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

_FELT = "the accelerometer"
_IN_LAYER = 1.0 / 3.0  # of a voxel
_UPSIDE_DOWN = 10
"""Patches that face down for each that faces up, above which a LiDAR hangs: outdoors no patch faces down, and
in rooms, where the ceiling is seen as well, about as many as face up."""


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
    held roughly upright. The mounting and the axes of the accelerometer that the log states, or that the path
    shows, are weighed against it.

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
    patches = patches_of(scans, tolerance_m=tolerance_m)
    rough = _rough_up(patches, trajectory, accelerations, config=config, axes=axes)
    up_world, method, up_detail = _up(
        patches, trajectory, accelerations, up_guess=rough.up_world, tolerance_m=tolerance_m
    )
    if axes.stands_on_floor:
        floor = floor_below(scans, up_world, tolerance_m=tolerance_m)
    else:
        heights_m = heights_of(scans, up_world)
        floor = floor_of(patches, heights_m, up_world=up_world, tolerance_m=tolerance_m)
    if axes.floor_world is not None:
        floor = weighed(floor, axes.floor_world @ up_world)
    T_level_world = _frame(trajectory.T_world_body[0], up_world, floor.height_m, axes)
    details = [*filter(None, [up_detail, rough.assumption, floor.detail])]
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
    """Direction in the world within 60° of which up is.

    Attributes:
        up_world: (3,) the direction.
        conflict: As in ``Level``.
        is_decided: As in ``Level``.
        assumption: Sentence on a direction that nothing in the log states; else empty.
    """

    up_world: Array
    conflict: str = ""
    is_decided: bool = True
    assumption: str = ""


def _rough_up(
    patches: Patches,
    trajectory: Trajectory,
    accelerations: Accelerations | None,
    *,
    config: LevelConfig,
    axes: BodyAxes,
) -> _RoughUp:
    """Return up as tf mounts the sensor, as its accelerometer feels it, or along its own axis.

    The first of them that the log states is taken. Where they contradict each other, it is the first below
    which a LiDAR sees a floor: drivers turn the clouds of an inverted one, but may leave tf and accelerometer
    as they are. Of a camera, whose images show floors and ceilings alike, it is the accelerometer if the
    path's turns and changes of velocity confirm it.
    """
    if config.up[-1] in "xyz":
        axis = np.eye(3)["xyz".index(config.up[-1])]
        return _RoughUp(mean_up(trajectory, -axis if config.up[0] == "-" else axis))
    candidates = _candidates(trajectory, accelerations, axes)
    chosen, is_decided = candidates[0], True
    if any(chosen.contradicts(other) for other in candidates):
        is_decided = accelerations is not None and accelerations.are_checked
        if axes.stands_on_floor:
            chosen, is_decided = _above_floor(candidates, patches, config.plane_tolerance_m)
    if config.up != "auto" and len(candidates) > 1:
        is_wanted = [(one.name == _FELT) == (config.up == "accelerometer") for one in candidates]
        chosen, is_decided = candidates[is_wanted.index(True)] if any(is_wanted) else chosen, True
    against = next((one for one in candidates if one.is_stated and chosen.contradicts(one)), None)
    if against is None:
        if chosen.name == _FELT or config.up != "auto":
            return _RoughUp(chosen.up_world)
        assumption = "" if axes.are_stated else f"up is taken to be {chosen.name}, as nothing states it"
        conflict = _hanging(chosen, patches, config.plane_tolerance_m) if axes.stands_on_floor else ""
        return _RoughUp(chosen.up_world, conflict, not conflict, assumption)
    angle_deg = np.degrees(chosen.angle_to(against))
    doubt = "" if is_decided else " though nothing decides"
    conflict = (
        f"up by {against.name} is {angle_deg:.0f}° from up by {chosen.name}, which is taken{doubt}; "
        "level.up=sensor or level.up=accelerometer says which is right"
    )
    return _RoughUp(chosen.up_world, conflict, is_decided)


def _candidates(
    trajectory: Trajectory, accelerations: Accelerations | None, axes: BodyAxes
) -> list["_Candidate"]:
    """Return what says which way is up, the first of which is taken where nothing contradicts it."""
    is_camera = not axes.stands_on_floor
    own = "the top of the images" if is_camera else "the sensor's z axis"
    mounted = _Candidate("the mounting in tf" if axes.are_stated else own, axes.up_in(trajectory))
    up_felt = up_in_stated_axes(accelerations, trajectory)
    if accelerations is None or up_felt is None:
        felt = []
    else:
        is_reversed = is_camera and not accelerations.are_checked and mounted.is_opposite(up_felt)
        felt = [_Candidate(_FELT, -up_felt if is_reversed else up_felt)]  # some point down at rest
        if is_camera and accelerations.are_checked:
            return [*felt, mounted]
    if not axes.are_stated:
        return [*felt, mounted]
    if is_camera:
        return [mounted, *felt]
    z_axis = _Candidate(own, mean_up(trajectory, AXES["lidar"].up), is_stated=False)
    return [mounted, *felt, z_axis]


def _above_floor(
    candidates: Sequence["_Candidate"], patches: Patches, tolerance_m: float
) -> tuple["_Candidate", bool]:
    """Return the first candidate with a floor below it, and whether none with a floor contradicts it."""
    facing = [_facing(patches, candidate.up_world, tolerance_m) for candidate in candidates]
    with_floor = [
        candidate
        for candidate, (up, down) in zip(candidates, facing, strict=True)
        if up >= MIN_PATCHES and up > down
    ]
    if not with_floor:
        return candidates[0], False
    return with_floor[0], not any(with_floor[0].contradicts(other) for other in with_floor)


def _hanging(chosen: "_Candidate", patches: Patches, tolerance_m: float) -> str:
    """Return that a LiDAR seems to hang upside down; empty if it does not."""
    facing_up, facing_down = _facing(patches, chosen.up_world, tolerance_m)
    if facing_down < MIN_PATCHES or facing_down <= _UPSIDE_DOWN * facing_up:
        return ""
    return (
        f"of the level patches {facing_down} face down and {facing_up} up: is the LiDAR mounted "
        f"upside down? Up is taken by {chosen.name}; level.up=-z turns the map over, "
        "level.up=sensor says that it is right"
    )


def _facing(patches: Patches, up_guess: Array, tolerance_m: float) -> tuple[int, int]:
    """Return how many patches face up, as a floor does, and down, if up is within 60° of a direction."""
    if not len(patches):
        return 0, 0
    vertical = vertical_of(patches, up_guess_world=up_guess, tolerance_m=tolerance_m)
    cosine = patches.normals_world @ vertical.up_world
    return int((cosine > np.cos(PARALLEL_RAD)).sum()), int((cosine < -np.cos(PARALLEL_RAD)).sum())


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A direction in the world that may be up, and whether the log or the way a sensor is held says so."""

    name: str
    up_world: Array
    is_stated: bool = True

    def angle_to(self, other: "_Candidate") -> float:
        return float(np.arccos(np.clip(self.up_world @ other.up_world, -1.0, 1.0)))

    def contradicts(self, other: "_Candidate") -> bool:
        return self.angle_to(other) > float(MAX_TILT_RAD)

    def is_opposite(self, up_world: Array) -> bool:
        return bool(self.up_world @ up_world < -np.cos(MAX_TILT_RAD))


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
        up_world, detail = up_by_accelerometer(accelerations, trajectory, up_guess)
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
