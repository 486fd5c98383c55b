"""Search of a scan's pose: by prediction, and where that fits less than usual, by all other ways."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.geometry import Transform, angle_between, exp, inverse
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.motion_model import MotionModel
from mapper.odometry.scan_to_map.observed_part import MEASURED, Blend, observed_part
from mapper.odometry.scan_to_map.scan_fit import (
    ScanFit,
    ScanKeyframe,
    contradiction,
    described,
    directions_of,
    fit_of,
)
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan, ScanMatcher
from mapper.odometry.scan_to_map.usual_fit import Jump, Shares, UsualFit, jump_between
from mapper.registration.base import Aligner
from mapper.registration.factory import build_registration
from mapper.registration.refining import refined_motion

_TURNS_RAD = (0.3, -0.3, 0.6, -0.6, 1.0, -1.0)  # about the vertical, from the predicted pose
_PAIR_DISTANCES = (4.0, 2.0, 1.0)  # of a scan to the last keyframe or scan, in largest pair distances
_MAX_POINTS = 2500  # of the scan; fewer than twice as many are used
_CONTRADICTION_WEIGHT = 15.0
_ALIKE = 0.1  # scores nearer than this do not decide
_GOOD = 0.75  # a score of this part of the usual one ends the search
_FAIR, _GUESSES = 0.5, 3  # and so does one of this part to which so many guesses lead
_SAME_VOXELS, _SAME_RAD = 0.25, 0.01  # two answers of a registration that differ less are one


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """A pose of the body in the middle of a scan's sweep.

    Attributes:
        keyframe: That it was compared with.
        T_world_middle: (4, 4) the pose.
        fit: On that keyframe.
        shares: What of it is compared with the usual.
        jump: From the predicted pose.
        blend: Of what was found and what was predicted.
        method: Step that found it.
    """

    keyframe: ScanKeyframe
    T_world_middle: Transform
    fit: ScanFit
    shares: Shares
    jump: Jump
    blend: Blend
    method: str

    @property
    def is_measured(self) -> bool:
        """Whether surfaces show all of the motion."""
        return bool(self.fit.observability.min() >= 1.0)

    @property
    def score(self) -> float:
        """Agreement less what contradicts, weighted; overlap does not tell, as ground lies on any ground."""
        return _score(self.shares)


class PoseSearch:
    """Search by a matcher and by registration to the last keyframes."""

    def __init__(self, config: ScanOdometryConfig, matcher: ScanMatcher) -> None:
        self.usual = UsualFit()
        self._config = config
        self._matcher = matcher
        self._rescue = build_registration(config.rescue) if config.rescue is not None else None
        self._rescuer: tuple[DeskewedScan, Aligner] | None = None

    def go_on(self, matcher: ScanMatcher, usual: UsualFit) -> None:
        """Go on with another map and other usual shares."""
        self._matcher, self.usual = matcher, usual

    def find(
        self,
        deskewed: DeskewedScan,
        keyframes: Sequence[ScanKeyframe],
        doubtful: ScanKeyframe | None,
        last: ScanKeyframe | None,
        motion: MotionModel,
        time_ns: int,
        T_world_guess: Transform | None = None,
    ) -> PoseCandidate | None:
        """Return the pose that fits best; None if no method finds one.

        Args:
            deskewed: The scan.
            keyframes: The last ones, the newest first.
            doubtful: Keyframe after them whose pose is in doubt.
            last: The last scan, if it is not a keyframe.
            motion: For the predicted pose.
            time_ns: Of the middle of the sweep.
            T_world_guess: (4, 4) where the matcher begins; None is the predicted pose.
        """
        T_world_predicted = motion.predicted(time_ns)
        spread = motion.spread(time_ns)
        is_believed = self._config.usual_ratio == 0.0
        directions = directions_of(deskewed)

        def assessed(found: Transform | None, key: ScanKeyframe, method: str) -> PoseCandidate | None:
            if found is None:
                return None
            fit = fit_of(
                key,
                deskewed,
                inverse(key.T_world_middle) @ found,
                max_pair_distance_m=self._config.max_pair_distance_m,
            )
            if fit is None:
                return None
            view = key.view_share(directions)
            shares = Shares(min(1.0, fit.overlap / view), min(1.0, fit.agreement / view), fit.contradicting)
            T_world_middle, blend = found, MEASURED
            if not is_believed:
                voxel_m = deskewed.prepared.voxel_m
                T_world_middle, blend = observed_part(fit, T_world_predicted, found, spread, voxel_m=voxel_m)
            jump = jump_between(T_world_predicted, T_world_middle, spread)
            return PoseCandidate(key, T_world_middle, fit, shares, jump, blend, method)

        T_world_begin = T_world_predicted if T_world_guess is None else T_world_guess
        T_world_near = self._matcher.match(deskewed, T_world_begin, reach="near")
        best: PoseCandidate | None = None
        for key in keyframes:
            near = assessed(T_world_near, key, "map")
            if near is not None and (is_believed or (not self.is_suspect(near) and near.is_measured)):
                return near
            best = self._preferred(best, near)
        if best is not None and not self.is_suspect(best):
            return best
        description = described(deskewed)

        def compared(candidate: PoseCandidate) -> PoseCandidate:
            """Return a candidate with the contradictions of both scans."""
            T_key_scan = inverse(candidate.keyframe.T_world_middle) @ candidate.T_world_middle
            share = contradiction(candidate.keyframe, description, T_key_scan)
            return replace(candidate, shares=replace(candidate.shares, contradicting=share))

        candidates = [] if best is None else [compared(best)]
        keys = [keyframes[0]]
        if doubtful is not None and not any(map(self.fits, candidates)):
            keys.append(doubtful)
            on_doubtful = assessed(T_world_near, doubtful, "map")
            candidates += [] if on_doubtful is None else [compared(on_doubtful)]
        # A pose that does not fit the keyframes may fit the doubtful one, so each has answers of its own.
        answers = {
            is_doubtful: Answers(
                deskewed.prepared.voxel_m,
                [c.T_world_middle for c in candidates if (c.keyframe is doubtful) == is_doubtful],
            )
            for is_doubtful in (False, True)
        }

        def enough() -> PoseCandidate | None:
            """Return the best pose so far if no other has to be tried."""
            best = _best(candidates)
            is_enough = best is not None and self._is_enough(best, answers[best.keyframe is doubtful])
            return best if is_enough else None

        if (found := enough()) is not None:
            return found
        for way in (self._nearby, self._globally):
            if way == self._globally and any(map(self.fits, candidates)):
                break
            for key in keys:
                for guess, T_world_middle, method in way(deskewed, key, last, motion, T_world_predicted):
                    if T_world_middle is None:
                        continue
                    if answers[key is doubtful].add(T_world_middle, guess):
                        candidate = assessed(T_world_middle, key, method)
                        if candidate is not None:
                            candidates.append(compared(candidate))
                    if (found := enough()) is not None:
                        return found
        return _best(candidates)

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
        """Return whether a pose fits less than usual, or is a surprise, so that others are tried."""
        return (
            candidate.jump.is_unusual
            or self.usual.agrees_little(candidate.shares)
            or not self.fits(candidate)
        )

    def _is_enough(self, best: PoseCandidate, answers: "Answers") -> bool:
        """Return whether no other pose has to be tried: it fits well, or several guesses lead to it."""
        usual = _score(self.usual.usual)
        if best.score >= _GOOD * usual and not self.is_suspect(best):
            return True
        return best.score >= _FAIR * usual and answers.guesses_of(best.T_world_middle) >= _GUESSES

    def fits(self, candidate: PoseCandidate) -> bool:
        """Return whether a pose fits as usual."""
        usual, shares = self.usual, candidate.shares
        return not (
            usual.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
            or usual.contradicts(shares)
            or usual.disagrees(shares)
        )

    def is_lost(self, candidate: PoseCandidate) -> bool:
        """Return whether next to nothing agrees, or too much speaks against the pose.

        Little overlap without contradictions is a doubt where the pose was predicted: the rings of a sensor
        that rolls soon leave those of the keyframe.
        """
        if self._config.lost_ratio == 0.0:
            return False
        usual, shares = self.usual, candidate.shares
        if not usual.is_known:  # in a field half of the points have partners
            return shares.overlap < 0.5 * self._config.lost_ratio
        share = shares.overlap / usual.usual.overlap
        little = usual.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
        contradicts, disagrees = usual.contradicts(shares), usual.disagrees(shares)
        if little and disagrees and not contradicts and self._is_where_predicted(candidate):
            return share < 0.5 * self._config.lost_ratio
        if little and usual.excludes(shares):
            return True
        speaks_against = contradicts or disagrees
        return share < (self._config.lost_ratio if speaks_against else 0.5 * self._config.lost_ratio)

    def _is_where_predicted(self, candidate: PoseCandidate) -> bool:
        """Return whether a pose is no surprise, and nearer to the predicted one than keyframes are."""
        jump, config = candidate.jump, self._config
        is_near = (
            jump.translation_m < config.keyframe_distance_m and jump.rotation_rad < config.keyframe_angle_rad
        )
        return is_near and bool(np.isfinite(jump.limit_m)) and not jump.is_unusual

    def doubts(self, candidate: PoseCandidate) -> tuple[str, ...]:
        """Return what speaks against a pose, a phrase each; empty if it is believed.

        Little overlap alone is a new room, and a jump alone a sudden turn. A direction that disagrees alone
        is a doubt where part of the motion was predicted.
        """
        if self._config.usual_ratio == 0.0:
            return ()
        usual, shares = self.usual, candidate.shares
        little = usual.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
        contradicts, disagrees = usual.contradicts(shares), usual.disagrees(shares)
        jumps = candidate.jump.is_unusual
        if not usual.is_known:
            little = disagrees = False
        is_alone = not contradicts and little + disagrees + jumps < 2
        tells_alone = (jumps and candidate.method == "rescued") or (disagrees and not candidate.is_measured)
        if is_alone and not tells_alone:
            return ()
        phrases = []
        if little:
            phrases.append(f"{shares.overlap:.0%} of the points agree, {usual.usual.overlap:.0%} is usual")
        if contradicts:
            phrases.append(
                f"{shares.contradicting:.1%} of the points lie where earlier rays passed, "
                f"{usual.usual.contradicting:.1%} is usual"
            )
        if disagrees:
            phrases.append(
                f"{shares.agreement:.0%} agree in the weakest direction, {usual.usual.agreement:.0%} is usual"
            )
        if jumps:
            phrases.append(candidate.jump.text)
        return tuple(phrases)

    def _nearby(
        self,
        deskewed: DeskewedScan,
        keyframe: ScanKeyframe,
        last: ScanKeyframe | None,
        motion: MotionModel,
        T_world_predicted: Transform,
    ) -> Iterator[tuple[int, Transform | None, str]]:
        """Yield poses that are found from the predicted one, from no motion, and from turns of both.

        Each comes with the number of its guess; that of the predicted pose is 0.
        """
        yield 0, self._matcher.match(deskewed, T_world_predicted, reach="far"), "far"
        up = T_world_predicted[2, :3]
        turned = [T_world_predicted @ exp(turn * up, np.zeros(3)) for turn in _TURNS_RAD]
        for guess, T_world_guess in enumerate((T_world_predicted, *turned, motion.T_world_last)):
            if self._matcher.uses_guess and guess > 0:  # from the predicted pose it was the first try
                yield guess, self._matcher.match(deskewed, T_world_guess, reach="near"), "turned"
            for key in dict.fromkeys((keyframe, keyframe if last is None else last)):
                T_key_scan = refined_motion(
                    key.deskewed.prepared,
                    deskewed.prepared,
                    inverse(key.T_world_middle) @ T_world_guess,
                    kind="plane-icp",
                    pair_distances_m=[k * self._config.max_pair_distance_m for k in _PAIR_DISTANCES],
                    max_points=_MAX_POINTS,
                )
                if not isinstance(T_key_scan, str):
                    T_world_found = key.T_world_middle @ T_key_scan
                    method = "keyframe" if key is keyframe else "scan"
                    yield guess, self._matcher.match(deskewed, T_world_found, reach="near"), method
                    yield guess, T_world_found, method

    def _globally(
        self,
        deskewed: DeskewedScan,
        keyframe: ScanKeyframe,
        last: ScanKeyframe | None,  # noqa: ARG002
        motion: MotionModel,  # noqa: ARG002
        T_world_predicted: Transform,  # noqa: ARG002
    ) -> Iterator[tuple[int, Transform | None, str]]:
        """Yield the pose that is found without a guess."""
        if self._rescue is None:
            return
        if self._rescuer is None or self._rescuer[0] is not keyframe.deskewed:
            self._rescuer = keyframe.deskewed, self._rescue.prepare(keyframe.deskewed.scan)
        found = self._rescuer[1].align(deskewed.scan, np.eye(4))
        if found.converged:
            T_world_found = keyframe.T_world_middle @ found.T_target_source
            yield len(_TURNS_RAD) + 2, self._matcher.match(deskewed, T_world_found, reach="near"), "rescued"
            yield len(_TURNS_RAD) + 2, T_world_found, "rescued"


class Answers:
    """Poses that registrations found, each with the guesses that led to it."""

    def __init__(self, voxel_m: float, first: Sequence[Transform]) -> None:
        """Begin with poses that guess 0 led to."""
        self._near_m = _SAME_VOXELS * voxel_m
        self._poses = [(T_world_body, {0}) for T_world_body in first]

    def add(self, T_world_body: Transform, guess: int) -> bool:
        """Add a pose; return whether it is a new one."""
        if (guesses := self._of(T_world_body)) is not None:
            guesses.add(guess)
            return False
        self._poses.append((T_world_body, {guess}))
        return True

    def guesses_of(self, T_world_body: Transform) -> int:
        """Return how many guesses led to a pose."""
        return len(self._of(T_world_body) or ())

    def _of(self, T_world_body: Transform) -> set[int] | None:
        for other, guesses in self._poses:
            difference = inverse(other) @ T_world_body
            if (
                np.linalg.norm(difference[:3, 3]) < self._near_m
                and angle_between(np.eye(3), difference[:3, :3]) < _SAME_RAD
            ):
                return guesses
        return None


def _score(shares: Shares) -> float:
    return shares.agreement - _CONTRADICTION_WEIGHT * shares.contradicting


def _best(candidates: Sequence[PoseCandidate]) -> PoseCandidate | None:
    """Return the best score, of those alike the one nearest to the predicted pose; None without any."""
    if not candidates:
        return None
    highest = max(candidate.score for candidate in candidates)
    alike = [candidate for candidate in candidates if candidate.score >= highest - _ALIKE]
    if len(alike) == 1:
        return alike[0]
    surprises = [_surprise(candidate) for candidate in alike]
    least = min(surprises)
    return max(
        (c for c, surprise in zip(alike, surprises, strict=True) if surprise <= least + 1.0),
        key=lambda candidate: candidate.score,
    )


def _surprise(candidate: PoseCandidate) -> float:
    """Return the jump in units of what would be much, or of 1 m and 1 rad where that is unknown."""
    jump = candidate.jump
    if not np.isfinite(jump.limit_m):
        return jump.translation_m + jump.rotation_rad
    return max(jump.translation_m / jump.limit_m, jump.rotation_rad / jump.limit_rad)
