"""Scans with their poses, and the state from which the last one is tracked again."""

import copy
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.geometry import Array
from mapper.odometry.base import FrameResult
from mapper.odometry.scan_to_map.keyframe_tree import KeyframeTree
from mapper.odometry.scan_to_map.motion_model import MotionModel
from mapper.odometry.scan_to_map.pose_candidate import PoseCandidate
from mapper.odometry.scan_to_map.scan_fit import ScanKeyframe
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan, ScanMatcher
from mapper.odometry.scan_to_map.scan_noise import ScanNoise
from mapper.odometry.scan_to_map.scan_observation import ScanObservation
from mapper.odometry.scan_to_map.usual_fit import UsualFit

_MOST_SIGMAS = 3.0  # of two velocities that are one


@dataclass(slots=True, eq=False)
class ScanState:
    """What tracking a scan changes.

    Attributes:
        matcher: With the map.
        usual: Fit of recent scans.
        noise: Of poses relative to the last keyframe.
        motion: Of the sensor.
        tree: Of the last keyframes.
        keyframes: The last ones, the newest first.
        doubtful: Keyframe after them whose pose is in doubt.
        last: The last scan.
        next_node: Number of the next keyframe.
    """

    matcher: ScanMatcher
    usual: UsualFit
    noise: ScanNoise
    motion: MotionModel
    tree: KeyframeTree
    keyframes: deque[ScanKeyframe]
    doubtful: ScanKeyframe | None = None
    last: ScanKeyframe | None = None
    next_node: int = 0

    def keyframe_of(self, node: int) -> ScanKeyframe:
        """Return the keyframe of a node, one of the last or the doubtful one."""
        known = self.keyframes if self.doubtful is None else (*self.keyframes, self.doubtful)
        return next(keyframe for keyframe in known if keyframe.node == node)

    def copy(self) -> "ScanState":
        """Return a copy; scans, which do not change, are shared."""
        changing = (self.matcher, self.usual, self.noise, self.motion, self.tree)
        matcher, usual, noise, motion, tree = copy.deepcopy(changing)
        return replace(
            self,
            matcher=matcher,
            usual=usual,
            noise=noise,
            motion=motion,
            tree=tree,
            keyframes=self.keyframes.copy(),
        )


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """A scan with its pose.

    Attributes:
        deskewed: The scan.
        found: Its pose in the middle of the sweep.
        twist: Velocity then, if it was measured; None is the mean one since the scan before.
        velocity_covariance: (6, 6) of the velocity, (rad/s)² and (m/s)².
        contradiction_radps: By how much later scans tell another rotation.
    """

    deskewed: DeskewedScan
    found: PoseCandidate
    twist: Twist | None
    velocity_covariance: Array
    contradiction_radps: float = 0.0

    @property
    def covariance_to_stamp(self) -> Array:
        """(6, 6) of the velocity between the middle of the sweep and the stamp."""
        return self.velocity_covariance + np.diag([self.contradiction_radps**2] * 3 + [0.0] * 3)

    def turns_otherwise(self, other: "PlacedScan") -> bool:
        """Return whether the measured rotation is farther from another one than their errors explain."""
        if self.twist is None or other.twist is None:
            return False
        off_radps = self.twist.rotation_radps - other.twist.rotation_radps
        covariance = (self.velocity_covariance + other.velocity_covariance)[:3, :3]
        return bool(off_radps @ np.linalg.solve(covariance, off_radps) > _MOST_SIGMAS**2)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedScan:
    """A scan whose velocity the next scan may correct.

    Attributes:
        first: First scan of its map, if it is the second one.
        observation: The scan.
        placed: Its pose.
        result: What was returned for it.
        state: Before it was tracked.
    """

    first: ScanObservation | None
    observation: ScanObservation
    placed: PlacedScan
    result: FrameResult
    state: ScanState
