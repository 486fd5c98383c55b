"""Attitude of a sensor's body, and the floor below the robot, as the log states them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.frames import Sensor
from mapper.core.geometry import Array, Points
from mapper.core.trajectory import Trajectory
from mapper.sources.base import BASES, Log


@dataclass(frozen=True, slots=True, eq=False)
class BodyAxes:
    """Rough attitude of a sensor's body.

    Attributes:
        up: (3,) unit vector that roughly points up, body frame.
        forward: (3,) unit vector along the body's heading, body frame.
        stands_on_floor: The floor is the surface below the sensor, not the lowest surface around: a street
            may fall away in range, and reflections lie below it.
        are_stated: The log says how the body is mounted.
        up_world: (3,) mean up of the robot, where the body moves on it and the log says how; else None.
        floor_world: (N, 3) points of the floor below the robot along its path, metres, if the log states it.
    """

    up: Array
    forward: Array
    stands_on_floor: bool = False
    are_stated: bool = False
    up_world: Array | None = None
    floor_world: Points | None = None

    def up_in(self, trajectory: Trajectory) -> Array:
        """Return the (3,) mean up direction, world frame; the first one if the body turns over."""
        return mean_up(trajectory, self.up) if self.up_world is None else self.up_world


AXES: Mapping[Sensor, BodyAxes] = {
    "rgbd": BodyAxes(up=np.array([0.0, -1.0, 0.0]), forward=np.array([0.0, 0.0, 1.0])),
    "lidar": BodyAxes(up=np.array([0.0, 0.0, 1.0]), forward=np.array([1.0, 0.0, 0.0]), stands_on_floor=True),
    "lidar-2d": BodyAxes(up=np.array([0.0, 0.0, 1.0]), forward=np.array([1.0, 0.0, 0.0])),
}


def axes_of(log: Log, trajectory: Trajectory) -> BodyAxes:
    """Return the axes of a log's body: by its mounting on the robot if that is stated, else by its sensor.

    Args:
        log: The log; frames other than a robot's base may have axes of any direction, and are not used.
        trajectory: Poses of the body.
    """
    axes = AXES[log.sensor]
    base = log.base_poses(trajectory)
    if not base or log.base_frame.rpartition("/")[2] not in BASES:
        return axes
    if log.base_height_m is not None:
        below_world = base.T_world_body[:, :3, 2] * log.base_height_m
        axes = replace(axes, floor_world=base.positions_world - below_world)
    if log.T_base_body is None:
        return replace(axes, up_world=mean_up(base, np.array([0.0, 0.0, 1.0])), are_stated=True)
    forward, _, up = log.T_base_body[:3, :3]
    return replace(axes, up=up, forward=forward, are_stated=True)


def mean_up(trajectory: Trajectory, up_body: Array) -> Array:
    """Return the (3,) mean of the body's up direction, world frame; the first one if the body turns over."""
    ups_world = trajectory.T_world_body[:, :3, :3] @ up_body
    mean: Array = ups_world.mean(axis=0)
    length = float(np.linalg.norm(mean))
    first: Array = ups_world[0]
    return mean / length if length > 0.3 else first
