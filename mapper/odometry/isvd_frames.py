"""Frames that ISVD odometry has tracked, and registrations of a new one against them."""

from dataclasses import dataclass

from mapper.core.deskew import Twist
from mapper.core.geometry import Array, Transform
from mapper.features.matching import Pairs
from mapper.odometry.isvd_registration import IsvdObservation
from mapper.registration.base import Alignment
from mapper.runtime.archived import Archived, archived


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A tracked frame.

    Attributes:
        node: Its node.
        observation: As its rows were read.
        T_world_body: (4, 4) as estimated when it was tracked.
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
