"""Search of a scan's pose: by prediction, and where that fits less than usual, by all other ways."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Transform, angle_between, exp, inverse
from mapper.odometry.scans.config import ScanOdometryConfig
from mapper.odometry.scans.motion_model import MotionModel
from mapper.odometry.scans.observed_part import observed_part
from mapper.odometry.scans.scan_fit import ScanFit, ScanKeyframe, contradiction, described, fit_of
from mapper.odometry.scans.scan_matcher import DeskewedScan, ScanMatcher
from mapper.odometry.scans.usual_fit import Jump, Shares, UsualFit, jump_between
from mapper.registration.base import Aligner
from mapper.registration.factory import build_registration
from mapper.registration.refining import refined_motion

_TURNS_RAD = (0.3, -0.3, 0.6, -0.6, 1.0, -1.0)  # about the vertical, from the predicted pose
_PAIR_DISTANCES = (4.0, 2.0, 1.0)  # of a scan to the last keyframe or scan, in largest pair distances
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
        open_m: (6,) errors of the motions that were predicted instead of measured.
        method: Step that found it.
    """

    keyframe: ScanKeyframe
    T_world_middle: Transform
    fit: ScanFit
    shares: Shares
    jump: Jump
    open_m: Array
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
            shares = Shares(fit.overlap, fit.agreement, fit.contradicting)
            T_world_middle, open_m = found, np.zeros(6)
            if not is_believed:
                voxel_m = deskewed.prepared.voxel_m
                T_world_middle, open_m = observed_part(fit, T_world_predicted, found, spread, voxel_m=voxel_m)
            jump = jump_between(T_world_predicted, T_world_middle, spread)
            return PoseCandidate(key, T_world_middle, fit, shares, jump, open_m, method)

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
        answers = Answers(deskewed.prepared.voxel_m, [c.T_world_middle for c in candidates])
        for way in (self._nearby, self._globally):
            if way == self._globally and any(map(self.fits, candidates)):
                break
            for key in (keyframes[0], doubtful) if doubtful is not None else (keyframes[0],):
                for guess, T_world_middle, method in way(deskewed, key, last, motion, T_world_predicted):
                    if T_world_middle is None:
                        continue
                    if answers.add(T_world_middle, guess):
                        found = assessed(T_world_middle, key, method)
                        if found is not None:
                            candidates.append(compared(found))
                    best = _best(candidates)
                    if best is not None and self._is_enough(best, answers):
                        return best
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
        """Return whether next to nothing agrees, or too much speaks against the pose."""
        if self._config.lost_ratio == 0.0:
            return False
        usual, shares = self.usual, candidate.shares
        if not usual.is_known:  # in a field half of the points have partners
            return shares.overlap < 0.5 * self._config.lost_ratio
        share = shares.overlap / usual.usual.overlap
        little = usual.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
        if little and usual.excludes(shares):
            return True
        speaks_against = usual.contradicts(shares) or usual.disagrees(shares)
        return share < (self._config.lost_ratio if speaks_against else 0.5 * self._config.lost_ratio)

    def doubts(self, candidate: PoseCandidate) -> tuple[Doubt, ...]:
        """Return what speaks against a pose; empty if it is believed.

        Little overlap alone is a new room, and a jump alone a sudden turn.
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
        if is_alone and not (jumps and candidate.method == "rescued"):
            return ()
        doubts = []
        if little:
            doubts.append(
                Doubt(
                    "disagreement",
                    f"{shares.overlap:.0%} of the points agree, {usual.usual.overlap:.0%} is usual",
                )
            )
        if contradicts:
            doubts.append(
                Doubt(
                    "elsewhere",
                    f"{shares.contradicting:.1%} of the points stand where rays passed, "
                    f"{usual.usual.contradicting:.1%} is usual",
                )
            )
        if disagrees:
            doubts.append(
                Doubt(
                    "disagreement",
                    f"{shares.agreement:.0%} agree in the weakest direction, "
                    f"{usual.usual.agreement:.0%} is usual",
                )
            )
        if jumps:
            doubts.append(Doubt("jump", candidate.jump.text))
        return tuple(doubts)

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
            for key in (keyframe, last) if last is not None else (keyframe,):
                T_key_scan = refined_motion(
                    key.deskewed.prepared,
                    deskewed.prepared,
                    inverse(key.T_world_middle) @ T_world_guess,
                    kind="plane-icp",
                    pair_distances_m=[k * self._config.max_pair_distance_m for k in _PAIR_DISTANCES],
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
