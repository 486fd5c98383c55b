"""Frames that ISVD odometry has tracked, and registrations of a new one against them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.geometry import Array, Transform, mean_pose, mean_rotation, transform
from mapper.features.matching import Pairs
from mapper.odometry.config import IsvdOdometryConfig
from mapper.odometry.isvd.registration import IsvdObservation
from mapper.registration.base import Alignment
from mapper.runtime.archived import Archived, archived


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A tracked frame.

    Attributes:
        node: Its node.
        observation: Observation as its rows were read.
        T_world_body: (4, 4) pose as estimated when it was tracked.
        twist: Velocity of the body in the image.
    """

    node: int
    observation: IsvdObservation
    T_world_body: Transform
    twist: Twist


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A tracked frame that is kept, with what it observed in the archive."""

    node: int
    observation: Archived[IsvdObservation]
    T_world_body: Transform
    twist: Twist

    def loaded(self) -> TrackedFrame:
        """Return the frame."""
        return TrackedFrame(self.node, self.observation.data, self.T_world_body, self.twist)


def kept(frame: TrackedFrame) -> Keyframe:
    """Return a frame with its observation in the archive."""
    return Keyframe(frame.node, archived(frame.observation), frame.T_world_body, frame.twist)


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """Registration of a new frame against an earlier one.

    Attributes:
        earlier: The earlier frame, the target.
        alignment: The motion, earlier ← new.
        information: (6, 6) of the motion, with the error that its features share.
        weight: Its quality W, 1/m (eq. 4.1).
        pairs: (M, 2) matched features, with or without depth.
        T_world_body: (4, 4) pose of the new frame by this registration.
    """

    earlier: TrackedFrame
    alignment: Alignment
    information: Array
    weight: float
    pairs: Pairs
    T_world_body: Transform


def average_pose(candidates: Sequence[PoseCandidate], config: IsvdOdometryConfig) -> Transform:
    """Return T_world_body, the average of the candidates' poses (alg. 7, lines 21–27).

    Args:
        candidates: Registrations of a frame, the nearest earlier frame's first.
        config: Settings of the average.
    """
    poses = np.array([candidate.T_world_body for candidate in candidates])
    if config.average == "information":
        return mean_pose(poses[0], poses, [candidate.information for candidate in candidates])
    weights = np.array([candidate.weight for candidate in candidates])
    if config.average == "mean":
        weights = np.ones(len(candidates))
    translation: Array = weights @ poses[:, :3, 3] / weights.sum()
    R_world_body = poses[0, :3, :3]
    if config.rotation == "mean":
        R_world_body = mean_rotation(poses[:, :3, :3], weights)
    return transform(R_world_body, translation)
