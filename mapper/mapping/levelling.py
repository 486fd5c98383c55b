"""Levelling: up and the floor, which give the world frame of the maps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Points, Transform, exp, transform
from mapper.core.trajectory import Trajectory
from mapper.mapping.body_axes import BodyAxes
from mapper.mapping.config import LevelConfig
from mapper.mapping.floor_height import floor_below, floor_of, heights_of, weighed
from mapper.mapping.up_direction import rough_up, up_of
from mapper.mapping.wall_direction import WallHeading, wall_heading
from mapper.registration.planes import (
    Patches,
    patches_of,
)
from mapper.registration.surfaces import prepared
from mapper.sources.base import Accelerations

_IN_LAYER = 1.0 / 3.0  # of a voxel


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
    rough = rough_up(patches, trajectory, accelerations, config=config, axes=axes)
    up_world, method, up_detail = up_of(
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
