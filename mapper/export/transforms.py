"""Transforms between a run's coordinate frames, the same in its MCAP log and in its ROS 2 bag."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.geometry import Transform
from mapper.export.mcap_messages import MAP
from mapper.mapping.map_building import Snapshot
from mapper.run.folder import Run
from mapper.run.manifest_logs import RobotFrames
from mapper.run.stored_tracking import base_in_body
from mapper.sources.ros.decode import decode
from mapper.sources.ros.mcap_file import open_mcap

BODY = "body"
"""Name of the body where the log has none."""
CAMERA = "camera"
"""Name of an image's frame that is not the body."""
_EARLIER_MAP = "world"
"""Name of the levelled world in the logs of runs of earlier versions."""

Link = tuple[str, str, Transform]
"""Parent, child and T_parent_child."""


@dataclass(frozen=True, slots=True, eq=False)
class Transforms:
    """A tree of frames below the map.

    Attributes:
        body: Name of the body.
        static: Links that stay.
        moving: Links at each stamp of the trajectory.
    """

    body: str
    static: Sequence[Link]
    moving: Sequence[tuple[int, Sequence[Link]]]

    def camera_of(self, snapshot: Snapshot) -> str:
        """Return the frame of an image: the body itself, unless its camera is another."""
        return self.body if np.array_equal(snapshot.T_body_camera, np.eye(4)) else CAMERA


def transforms_of(run: Run) -> Transforms:
    """Return the transforms of a run whose trajectory is written, by the names of its log.

    A base on which the body stays is between the map and the body; one on which it moves is below the body.
    """
    robot = run.manifest.input.robot_of_all or RobotFrames()
    body = BODY if robot.body in ("", MAP) else robot.body
    child, poses, static = body, run.trajectory, list[Link]()
    if robot.mounting is not None and robot.base != body:
        child, poses = robot.base, robot.trajectory_of_base(poses)
        static.append((robot.base, body, robot.mounting))
    for sensor in robot.sensors:
        parent = body if sensor.parent == robot.body else sensor.parent
        static.append((parent, sensor.name, sensor.mounting))
    T_body_base = dict(base_in_body(run).items())
    moving = []
    for stamp_ns, T_map_child in poses.items():
        links = [(MAP, child, T_map_child)]
        if stamp_ns in T_body_base:
            links.append((body, robot.base, T_body_base[stamp_ns]))
        moving.append((stamp_ns, links))
    return Transforms(body, static, moving)


def root_of(path: Path) -> tuple[str, str]:
    """Return how a run's MCAP log names the levelled world, and the frame that moves in it."""
    for topic, _, _, data in open_mcap(path).messages():
        message = decode(topic, data) if topic.name == "/tf" else None
        for told in message if isinstance(message, list) else ():
            if told.parent in (MAP, _EARLIER_MAP):
                return told.parent, told.child
    return MAP, BODY
