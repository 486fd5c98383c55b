"""Scan with its pose and its velocity."""

from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.geometry import Array
from mapper.odometry.scan_to_map.pose_candidate import PoseCandidate
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan

_MOST_SIGMAS = 3.0  # of two velocities that are one


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """A scan with its pose.

    Attributes:
        deskewed: The scan.
        found: Its pose in the middle of the sweep.
        twist: Velocity then, if it was measured; None is the mean one since the scan before.
        velocity_covariance: (6, 6) of the velocity, (rad/s)² and (m/s)².
        contradiction_radps: Difference from the rotation that later scans show.
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
