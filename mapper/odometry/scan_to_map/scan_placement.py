"""Placement of a scan: its pose, and where its sweep may be bent, the velocity with it."""

import numpy as np

from mapper.core.deskew import STILL, Twist
from mapper.core.geometry import Transform
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.motion_model import covariance_unmeasured
from mapper.odometry.scan_to_map.placed_scan import PlacedScan
from mapper.odometry.scan_to_map.pose_candidate import PoseCandidate
from mapper.odometry.scan_to_map.pose_search import PoseSearch, UnplacedScan
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan
from mapper.odometry.scan_to_map.scan_noise import independent_covariance
from mapper.odometry.scan_to_map.scan_observation import ScanObservation
from mapper.odometry.scan_to_map.scan_state import ScanState
from mapper.odometry.scan_to_map.sweep_motion import SweepMotion, sweep_motion

_SETTLED = 0.05
"""Displacement of a sweep's outer points, in voxels, by a change of the velocity: less ends the search for
the velocity."""
_ROUNDS = 3
_WIDENED = 2.0  # expected changes of the velocity, for turns begin and end suddenly


class ScanPlacement:
    """Search of a scan's pose together with the velocity during its sweep."""

    def __init__(self, config: ScanOdometryConfig, state: ScanState, search: PoseSearch) -> None:
        self._config = config
        self._state = state
        self._search = search

    def place(self, observation: ScanObservation, guess: PlacedScan | None = None) -> PlacedScan | None:
        """Return where a scan fits best; None if next to nothing agrees with any pose.

        A sensor that turned may have stopped meanwhile: where the sweep fits badly when it is deskewed by the
        predicted velocity, it is placed without one, too.
        """
        twist = self._state.motion.twist
        placed = self._placed_by(observation, guess, twist)
        if placed is not None and not self._search.doubts(placed.found):
            return placed
        if not observation.is_bent_by(float(np.linalg.norm(twist.rotation_radps))):
            return placed
        at_rest = self._placed_by(observation, guess, STILL)
        if placed is None or (at_rest is not None and not self._search.doubts(at_rest.found)):
            return at_rest
        return placed

    def _placed_by(
        self, observation: ScanObservation, guess: PlacedScan | None, twist: Twist
    ) -> PlacedScan | None:
        """Return where a scan fits best if its velocity is about the one given.

        Where the velocity may have changed so much that it displaces the points of the sweep, it is found
        together with the pose; not before the errors of a few predictions are known, as two scans, each with
        a velocity of its own, fit under wrong ones, too.
        """
        motion, time_ns = self._state.motion, observation.middle_ns
        deskewed, sigmas = observation.deskew(twist), motion.velocity_sigmas(time_ns)
        if motion.turning_change(time_ns) is None or not self.may_be_bent(observation):
            found = self.pose_of(deskewed, time_ns)
            if found is None:
                return None
            changes = np.maximum(sigmas, motion.change(time_ns, found.T_world_middle))
            return PlacedScan(deskewed, found, None, covariance_unmeasured(changes))
        if guess is None:
            T_world_predicted, start = motion.predicted(time_ns), twist
            matched = self._state.matcher.match(deskewed, T_world_predicted, reach="near")
            T_world_middle = T_world_predicted if matched is None else matched
        else:
            T_world_middle, start = guess.found.T_world_middle, guess.twist or twist
        found = None
        sweep: SweepMotion | None = None
        sweep_of_middle, settled = observation.sweep(observation.middle_s), np.zeros(3)
        for _ in range(_ROUNDS):
            of_pose = (
                motion.pose_covariance if found is None else independent_covariance(found.fit, found.blend)
            )
            expected, covariance = motion.velocity(time_ns, T_world_middle, of_pose)
            before = start if sweep is None else sweep.twist
            measured = sweep_motion(
                self._state.keyframes,
                sweep_of_middle,
                T_world_middle,
                expected,
                _WIDENED**2 * covariance,
                start=before,
                max_pair_distance_m=self._config.max_pair_distance_m,
            )
            if measured is None and found is not None:
                break
            if measured is not None:
                sweep, deskewed = measured, observation.deskew(measured.twist)
                settled = measured.twist.rotation_radps - before.rotation_radps
            found = self.pose_of(deskewed, time_ns, None if measured is None else measured.T_world_middle)
            if found is None:
                break
            T_world_middle = found.T_world_middle
            if measured is not None and observation.displacement(float(np.linalg.norm(settled))) < _SETTLED:
                break
        if found is None:
            deskewed, sweep = observation.deskew(twist), None
            found = self.pose_of(deskewed, time_ns)
        if found is None:
            return None
        if sweep is None:
            of_pose = independent_covariance(found.fit, found.blend)
            covariance = motion.velocity(time_ns, found.T_world_middle, of_pose)[1]
            return PlacedScan(deskewed, found, None, covariance)
        accelerated = motion.acceleration(time_ns, found.T_world_middle, sweep.twist)
        changed = settled**2 + (accelerated * observation.half_s / 3.0) ** 2
        covariance = sweep.covariance + np.diag([*changed, 0.0, 0.0, 0.0])
        return PlacedScan(deskewed, found, sweep.twist, covariance)

    def pose_of(
        self, deskewed: DeskewedScan, time_ns: int, T_world_guess: Transform | None = None
    ) -> PoseCandidate | None:
        """Return the pose that fits best; None if next to nothing agrees with any."""
        state = self._state
        scan = UnplacedScan(deskewed, state.keyframes, state.doubtful, state.last, state.motion, time_ns)
        found = self._search.find(scan, T_world_guess)
        return None if found is None or self._search.is_lost(found) else found

    def may_be_bent(self, observation: ScanObservation) -> bool:
        """Return whether the velocity may have changed so much that it displaces the points of the sweep."""
        if observation.scan.times_s is None:
            return False
        change_radps = self._state.motion.turning_change(observation.middle_ns)
        return change_radps is None or observation.is_bent_by(change_radps)
