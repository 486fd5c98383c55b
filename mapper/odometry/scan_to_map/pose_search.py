"""Search of a scan's pose: by prediction, and where that fits less than usual, by all other ways."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import (
    Array,
    Transform,
    angle_between,
    exp,
    inverse,
    rotation_exp,
    transform,
    turn_to_z,
)
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.motion_model import MotionModel, Spread
from mapper.odometry.scan_to_map.observed_part import MEASURED, observed_part
from mapper.odometry.scan_to_map.pose_candidate import FoundPoses, PoseCandidate, best_of
from mapper.odometry.scan_to_map.scan_fit import (
    ScanKeyframe,
    contradiction,
    described,
    directions_of,
    fit_of,
)
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan
from mapper.odometry.scan_to_map.scan_state import ScanState
from mapper.odometry.scan_to_map.usual_fit import Shares, jump_between
from mapper.registration.base import Aligner
from mapper.registration.factory import build_registration
from mapper.registration.free_space import ScanDescription
from mapper.registration.planes import up_of
from mapper.registration.refining import refined_motion

_TURNS_RAD = (0.3, -0.3, 0.6, -0.6, 1.0, -1.0)  # about the vertical, from the predicted pose
_HEADINGS = 8  # evenly around the vertical
_PAIR_DISTANCES = (4.0, 2.0, 1.0)  # of a scan to the last keyframe or scan, in largest pair distances
_MAX_POINTS = 2500  # of the scan; fewer than twice as many are used
_GOOD = 0.75  # a score of this part of the usual one ends the search
_FAIR, _GUESSES = 0.5, 3  # and so does one of this part to which so many guesses lead
_FASTEST_RADPS = 4.0 * np.pi  # two turns a second; heads and drones that turn faster are not scanned with
_FASTEST_MPS = 45.0  # of a sensor whose velocity is not known yet
_STANDING_OVERLAP = 0.8
"""Overlap of a sensor that is slow or stands, as along tunnels with 0.86 and more. Motorways at 22 to 31 m/s
have up to 0.7 where it seems to stand. 0.95 serves as well, but for tunnels whose walls repeat themselves."""
_FASTER_STEP, _MOST_STEPS = 4.0, 5  # of poses from which faster ones are searched, in pair distances
_MOSTLY = 0.7  # part of an axis of the body that lies along motions which surfaces do not show
_LEAST_AGREEMENT = 0.1  # of a pose that is searched for: where scans hardly overlap, nothing contradicts

_Attempt = tuple[int, Transform | None, str]
"""Number of the guess, that of the predicted pose is 0; the pose that it led to; the method."""


@dataclass(frozen=True, eq=False)
class UnplacedScan:
    """Scan whose pose is searched for, and what it is compared with.

    Attributes:
        deskewed: The scan.
        keyframes: The last ones, the newest first.
        doubtful: Keyframe after them whose pose is in doubt.
        last: The last scan, if it is not a keyframe.
        motion: For the predicted pose.
        time_ns: Of the middle of the sweep.
    """

    deskewed: DeskewedScan
    keyframes: Sequence[ScanKeyframe]
    doubtful: ScanKeyframe | None
    last: ScanKeyframe | None
    motion: MotionModel
    time_ns: int

    @cached_property
    def prediction(self) -> Transform:
        """(4, 4) T_world_middle by the motion model."""
        return self.motion.predicted(self.time_ns)

    @cached_property
    def spread(self) -> Spread | None:
        """Errors of earlier predictions."""
        return self.motion.spread(self.time_ns)

    def can_have_turned_to(self, T_world_middle: Transform) -> bool:
        """Return whether the sensor can have turned to a pose (4, 4) since the last scan that was placed."""
        turn_rad = angle_between(self.motion.T_world_last[:3, :3], T_world_middle[:3, :3])
        return turn_rad <= _FASTEST_RADPS * self.motion.elapsed_s(self.time_ns)

    @cached_property
    def directions(self) -> int:
        """Number of directions in which the scan has returns."""
        return directions_of(self.deskewed)

    @cached_property
    def description(self) -> ScanDescription:
        """Points and rays for the free-space check."""
        return described(self.deskewed)

    @cached_property
    def up(self) -> Array | None:
        """(3,) up by the planes in the scan, body frame; None if they leave it open."""
        return up_of(self.deskewed.prepared)


class PoseSearch:
    """Search by a matcher and by registration to the last keyframes."""

    def __init__(self, config: ScanOdometryConfig, state: ScanState) -> None:
        self._config = config
        self._state = state
        self._global_registration = build_registration(config.rescue) if config.rescue is not None else None
        self._global_aligner: tuple[DeskewedScan, Aligner] | None = None

    def find(self, scan: UnplacedScan, T_world_guess: Transform | None = None) -> PoseCandidate | None:
        """Return the pose that fits best; None if no method finds one.

        Args:
            scan: The scan.
            T_world_guess: (4, 4) where the matcher begins; None is the predicted pose.
        """
        accepts_all = self._config.usual_ratio == 0.0
        T_world_begin = scan.prediction if T_world_guess is None else T_world_guess
        T_world_near = self._state.matcher.match(scan.deskewed, T_world_begin, reach="near")
        best: PoseCandidate | None = None
        for key in scan.keyframes:
            near = self._assessed(scan, T_world_near, key, "map")
            if near is not None and (accepts_all or (not self.is_suspect(near) and near.is_measured)):
                return near
            best = self._preferred(best, near)
        if best is not None and not accepts_all and (faster := self._faster(scan, best)) is not None:
            return faster
        if best is not None and not self.is_suspect(best):
            return best
        candidates = [] if best is None else [_compared(scan, best)]
        keys = [scan.keyframes[0]]
        if scan.doubtful is not None and not any(map(self.fits, candidates)):
            keys.append(scan.doubtful)
            on_doubtful = self._assessed(scan, T_world_near, scan.doubtful, "map")
            candidates += [] if on_doubtful is None else [_compared(scan, on_doubtful)]
        return self._searched(scan, keys, candidates)

    def _faster(self, scan: UnplacedScan, slow: PoseCandidate) -> PoseCandidate | None:
        """Return the best pose farther along motions that surfaces do not show at a slow one; None without.

        While no velocity is known, the sensor may move faster than the matcher reaches: on a road its rings
        lie on those of the keyframe as if it stood, but trees and posts beside it do not.
        """
        if scan.spread is not None or slow.fit.overlap >= _STANDING_OVERLAP:
            return None
        step_m = _FASTER_STEP * self._config.max_pair_distance_m
        count = int(_FASTEST_MPS * scan.motion.elapsed_s(scan.time_ns) / step_m + 0.5)
        found = []
        open_part = slow.fit.degeneracy.directions.T @ slow.fit.degeneracy.directions
        for axis in open_part[np.linalg.norm(open_part, axis=1) >= _MOSTLY]:
            for steps in range(1, min(count, _MOST_STEPS) + 1):
                for way_m in (steps * step_m, -steps * step_m):
                    T_world_guess = slow.T_world_middle @ transform(np.eye(3), way_m * axis)
                    T_world_found = self._state.matcher.match(scan.deskewed, T_world_guess, reach="near")
                    found.append(self._assessed(scan, T_world_found, slow.keyframe, "map"))
        measured = [_compared(scan, pose) for pose in found if pose is not None and pose.is_measured]
        fitting = [pose for pose in measured if not self._state.usual.contradicts(pose.shares)]
        fastest = max(fitting, key=lambda pose: pose.score, default=None)
        if fastest is None or (slow.is_measured and slow.score >= fastest.score):
            return None
        return fastest

    def _searched(
        self, scan: UnplacedScan, keys: Sequence[ScanKeyframe], candidates: list[PoseCandidate]
    ) -> PoseCandidate | None:
        """Return the best pose of all ways, tried in turn until one is good enough.

        Args:
            scan: The scan.
            keys: Keyframes that it is registered to.
            candidates: Poses by prediction, with the contradictions of both scans.
        """
        # A pose that does not fit the keyframes may fit the doubtful one, so the poses of each count apart.
        found_poses = {
            is_doubtful: FoundPoses(
                scan.deskewed.prepared.voxel_m,
                [c.T_world_middle for c in candidates if (c.keyframe is scan.doubtful) == is_doubtful],
            )
            for is_doubtful in (False, True)
        }

        def enough() -> PoseCandidate | None:
            """Return the best pose so far if no other has to be tried."""
            best = best_of(candidates, other_m=self._config.max_pair_distance_m)
            is_enough = best is not None and self._is_enough(
                best, found_poses[best.keyframe is scan.doubtful]
            )
            return best if is_enough else None

        if (found := enough()) is not None:
            return found
        for way in (self._nearby, self._by_heading, self._globally):
            if way != self._nearby and any(map(self.fits, candidates)):
                break
            for key in keys:
                for guess, T_world_middle, method in way(scan, key):
                    if T_world_middle is None or not scan.can_have_turned_to(T_world_middle):
                        continue
                    if found_poses[key is scan.doubtful].add(T_world_middle, guess):
                        candidate = self._assessed(scan, T_world_middle, key, method)
                        if candidate is not None and candidate.shares.agreement >= _LEAST_AGREEMENT:
                            candidates.append(_compared(scan, candidate))
                    if (found := enough()) is not None:
                        return found
        return best_of(candidates, other_m=self._config.max_pair_distance_m)

    def _assessed(
        self, scan: UnplacedScan, found: Transform | None, key: ScanKeyframe, method: str
    ) -> PoseCandidate | None:
        """Return a pose with its fit on a keyframe; None if nothing fits."""
        if found is None:
            return None
        fit = fit_of(
            key,
            scan.deskewed,
            inverse(key.T_world_middle) @ found,
            max_pair_distance_m=self._config.max_pair_distance_m,
            is_velocity_known=scan.spread is not None,
        )
        if fit is None:
            return None
        view = key.view_share(scan.directions)
        shares = Shares(min(1.0, fit.overlap / view), min(1.0, fit.agreement / view), fit.contradicting)
        T_world_middle, blend = found, MEASURED
        if self._config.usual_ratio > 0.0:
            voxel_m = scan.deskewed.prepared.voxel_m
            T_world_middle, blend = observed_part(fit, scan.prediction, found, scan.spread, voxel_m=voxel_m)
        jump = jump_between(scan.prediction, T_world_middle, scan.spread)
        return PoseCandidate(key, T_world_middle, fit, shares, jump, blend, method)

    def _preferred(self, one: PoseCandidate | None, other: PoseCandidate | None) -> PoseCandidate | None:
        """Return the one that is less suspect and whose keyframe shows more of the motion."""
        if one is None or other is None:
            return one or other

        def rank(candidate: PoseCandidate) -> tuple[bool, float, float]:
            fit = candidate.fit
            shown = float(fit.observability.min()), float(fit.degeneracy.shares[0])
            return not self.is_suspect(candidate), *shown

        return other if rank(other) > rank(one) else one

    def is_suspect(self, candidate: PoseCandidate) -> bool:
        """Return whether a pose fits less than usual, or jumps unusually, so that others are tried."""
        return (
            candidate.jump.is_unusual
            or self._state.usual.agrees_little(candidate.shares)
            or not self.fits(candidate)
        )

    def _is_enough(self, best: PoseCandidate, found_poses: FoundPoses) -> bool:
        """Return whether no other pose has to be tried: it fits well, or several guesses lead to it."""
        usual = self._state.usual.usual.score
        if best.score >= _GOOD * usual and not self.is_suspect(best):
            return True
        return best.score >= _FAIR * usual and found_poses.guesses_of(best.T_world_middle) >= _GUESSES

    def fits(self, candidate: PoseCandidate) -> bool:
        """Return whether a pose fits as usual."""
        usual, shares = self._state.usual, candidate.shares
        return not (
            usual.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
            or usual.contradicts(shares)
            or usual.disagrees(shares)
        )

    def is_lost(self, candidate: PoseCandidate) -> bool:
        """Return whether next to nothing agrees, or too much contradicts the pose.

        Little overlap without contradictions is a doubt where the pose was predicted: the rings of a sensor
        that rolls soon leave those of the keyframe.
        """
        if self._config.lost_ratio == 0.0:
            return False
        usual, shares = self._state.usual, candidate.shares
        if not usual.is_known:  # in a field half of the points have partners
            return shares.overlap < 0.5 * self._config.lost_ratio
        share = shares.overlap / usual.usual.overlap
        little = usual.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
        contradicts, disagrees = usual.contradicts(shares), usual.disagrees(shares)
        if little and disagrees and not contradicts and self._is_where_predicted(candidate):
            return share < 0.5 * self._config.lost_ratio
        if little and usual.excludes(shares):
            return True
        is_contradicted = contradicts or disagrees
        return share < (self._config.lost_ratio if is_contradicted else 0.5 * self._config.lost_ratio)

    def _is_where_predicted(self, candidate: PoseCandidate) -> bool:
        """Return whether a pose is nearer to the predicted one than keyframes are, and its jump usual."""
        jump, config = candidate.jump, self._config
        is_near = (
            jump.translation_m < config.keyframe_distance_m and jump.rotation_rad < config.keyframe_angle_rad
        )
        return is_near and bool(np.isfinite(jump.limit_m)) and not jump.is_unusual

    def doubts(self, candidate: PoseCandidate) -> tuple[Doubt, ...]:
        """Return the evidence against a pose; empty if there is too little.

        Little overlap alone is a new room, and a jump alone a sudden turn. A direction that disagrees alone
        is a doubt where part of the motion was predicted, and another pose that fits as well where the pose
        was searched.
        """
        if self._config.usual_ratio == 0.0:
            return ()
        usual, shares = self._state.usual, candidate.shares
        little = usual.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
        contradicts = usual.contradicts(shares, of_wide_search=candidate.method == "rescued")
        disagrees, jumps = usual.disagrees(shares), candidate.jump.is_unusual
        if not usual.is_known:
            little = disagrees = False
        is_alone = not contradicts and little + disagrees + jumps < 2
        suffices_alone = (
            candidate.is_one_of_two
            or (jumps and candidate.method == "rescued")
            or (disagrees and not candidate.is_measured)
        )
        if is_alone and not suffices_alone:
            return ()
        doubts = []
        if little:
            text = f"{shares.overlap:.0%} of the points agree, {usual.usual.overlap:.0%} is usual"
            doubts.append(Doubt("little overlap", text))
        if contradicts:
            text = (
                f"{shares.contradicting:.1%} of the points lie where earlier rays passed, "
                f"{usual.usual.contradicting:.1%} is usual"
            )
            doubts.append(Doubt("points in free space", text))
        if disagrees:
            usual_text = f"{usual.usual.agreement:.0%} is usual"
            text = f"{shares.agreement:.0%} agree in the weakest direction, {usual_text}"
            doubts.append(Doubt("weak direction", text))
        if candidate.is_one_of_two:
            doubts.append(Doubt("another pose", "another pose fits as well"))
        if jumps:
            doubts.append(Doubt("jump", candidate.jump.text))
        return tuple(doubts)

    def _nearby(self, scan: UnplacedScan, keyframe: ScanKeyframe) -> Iterator[_Attempt]:
        """Yield poses that are found from the predicted one, from no motion, and from turns of both."""
        T_world_predicted = scan.prediction
        yield 0, self._state.matcher.match(scan.deskewed, T_world_predicted, reach="far"), "far"
        up = T_world_predicted[2, :3]
        turned = [T_world_predicted @ exp(turn * up, np.zeros(3)) for turn in _TURNS_RAD]
        for guess, T_world_guess in enumerate((T_world_predicted, *turned, scan.motion.T_world_last)):
            if self._state.matcher.uses_guess and guess > 0:  # from the predicted pose it was the first try
                yield guess, self._state.matcher.match(scan.deskewed, T_world_guess, reach="near"), "turned"
            for key in dict.fromkeys((keyframe, keyframe if scan.last is None else scan.last)):
                method = "keyframe" if key is keyframe else "scan"
                for T_world_found in self._registered(scan, key, T_world_guess):
                    yield guess, T_world_found, method

    def _by_heading(self, scan: UnplacedScan, keyframe: ScanKeyframe) -> Iterator[_Attempt]:
        """Yield poses that are found from all headings where the last scan was.

        In each the scan is as upright as the keyframe, by the planes in both.
        """
        if scan.up is None or keyframe.up is None:
            return
        R_world_level = keyframe.T_world_middle[:3, :3] @ turn_to_z(keyframe.up).T
        for k in range(_HEADINGS):
            heading = rotation_exp(np.array([0.0, 0.0, 2.0 * np.pi * k / _HEADINGS]))
            R_world_body = R_world_level @ heading @ turn_to_z(scan.up)
            T_world_guess = transform(R_world_body, scan.motion.T_world_last[:3, 3])
            for T_world_found in self._registered(scan, keyframe, T_world_guess):
                yield len(_TURNS_RAD) + 2 + k, T_world_found, "rescued"

    def _globally(self, scan: UnplacedScan, keyframe: ScanKeyframe) -> Iterator[_Attempt]:
        """Yield the pose that is found without a guess."""
        if self._global_registration is None:
            return
        if self._global_aligner is None or self._global_aligner[0] is not keyframe.deskewed:
            aligner = self._global_registration.prepare(keyframe.deskewed.scan)
            self._global_aligner = keyframe.deskewed, aligner
        found = self._global_aligner[1].align(scan.deskewed.scan, np.eye(4))
        if found.converged:
            T_world_found = keyframe.T_world_middle @ found.T_target_source
            yield -1, self._state.matcher.match(scan.deskewed, T_world_found, reach="near"), "rescued"
            yield -1, T_world_found, "rescued"

    def _registered(
        self, scan: UnplacedScan, key: ScanKeyframe, T_world_guess: Transform
    ) -> Iterator[Transform | None]:
        """Yield the pose to which the registration to another scan leads, refined on the map and as it is."""
        T_key_scan = refined_motion(
            key.deskewed.prepared,
            scan.deskewed.prepared,
            inverse(key.T_world_middle) @ T_world_guess,
            kind="plane-icp",
            pair_distances_m=[k * self._config.max_pair_distance_m for k in _PAIR_DISTANCES],
            max_points=_MAX_POINTS,
        )
        if not isinstance(T_key_scan, str):
            T_world_found = key.T_world_middle @ T_key_scan
            yield self._state.matcher.match(scan.deskewed, T_world_found, reach="near")
            yield T_world_found


def _compared(scan: UnplacedScan, candidate: PoseCandidate) -> PoseCandidate:
    """Return a candidate with the contradictions of both scans."""
    T_key_scan = inverse(candidate.keyframe.T_world_middle) @ candidate.T_world_middle
    share = contradiction(candidate.keyframe, scan.description, T_key_scan)
    return replace(candidate, shares=replace(candidate.shares, contradicting=share))
