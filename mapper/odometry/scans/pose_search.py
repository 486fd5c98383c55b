"""Search of a scan's pose: from the prediction, and where that fits less than most, by other hypotheses."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mapper.core.geometry import Transform, exp, in_plane, inverse, length_and_angle
from mapper.odometry.scans.config import ScanOdometryConfig
from mapper.odometry.scans.motion_model import MotionModel, Spread
from mapper.odometry.scans.pose_assessment import PoseAssessment
from mapper.odometry.scans.pose_candidate import PoseCandidate, Shares, fuse_with_prediction, jump_between
from mapper.odometry.scans.scan_fit import ScanFit, ScanKeyframe, contradiction, described, fit_of, shares_on
from mapper.odometry.scans.scan_matcher import DeskewedScan, ScanMatcher
from mapper.registration.base import Aligner
from mapper.registration.factory import aligner_to
from mapper.registration.free_space import ScanDescription
from mapper.registration.pair_refinement import refined_motion

_TURNS_RAD = (0.3, -0.3, 0.6, -0.6, 1.0, -1.0)  # about the vertical, from the predicted pose
_PAIR_DISTANCES = (4.0, 2.0, 1.0)  # of a scan to the last keyframe or scan, in largest pair distances
_ALIKE = 0.1  # scores nearer than this do not decide
_GOOD = 0.75  # a score of this part of the median one ends the search
_FAIR, _GUESSES = 0.5, 3  # and so does one of this part to which this number of guesses leads
_SAME_VOXELS, _SAME_RAD = 0.25, 0.01  # two answers of a registration that differ less are one


@dataclass(frozen=True, slots=True, eq=False)
class KnownPath:
    """What is known of the path before a scan.

    Attributes:
        keyframes: The last keyframes, the newest first.
        doubtful: Keyframe after them whose pose is in doubt.
        last: The last scan.
        is_last_sure: Its pose is not in doubt.
        motion: Motion until then.
    """

    keyframes: Sequence[ScanKeyframe]
    doubtful: ScanKeyframe | None
    last: ScanKeyframe | None
    is_last_sure: bool
    motion: MotionModel

    @property
    def sure_scans(self) -> Sequence[ScanKeyframe]:
        """The last keyframes, and the last scan if its pose is not in doubt."""
        return (*self.keyframes, *((self.last,) if self.last is not None and self.is_last_sure else ()))


@dataclass(frozen=True, slots=True, eq=False)
class _Scan:
    """A scan with the pose that is predicted for it, what rules out another, and the sure scans before it."""

    deskewed: DeskewedScan
    T_world_predicted: Transform
    spread: Spread | None
    is_ruled_out: Callable[[Transform], bool]
    before: Sequence[ScanKeyframe]


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """A pose that a registration found, to be compared with a keyframe.

    Attributes:
        T_world_middle: (4, 4) the pose; None if the registration found none.
        keyframe: The keyframe.
        guess: Number of the guess that led to it; 0 is the predicted pose.
        method: Step that found it.
    """

    T_world_middle: Transform | None
    keyframe: ScanKeyframe
    guess: int
    method: str


class PoseSearch:
    """Search by a matcher and by registration to the last keyframes."""

    def __init__(self, config: ScanOdometryConfig, matcher: ScanMatcher, assessment: PoseAssessment) -> None:
        self._config = config
        self._matcher = matcher
        self._assessment = assessment
        self._believes_all = config.usual_ratio == 0.0
        self._rescue = config.rescue
        self._rescuer: tuple[DeskewedScan, Aligner] | None = None

    def find(
        self, deskewed: DeskewedScan, path: KnownPath, time_ns: int, T_world_guess: Transform | None = None
    ) -> PoseCandidate | None:
        """Return the pose that fits best; None if no method finds one, or next to nothing agrees.

        Args:
            deskewed: The scan.
            path: The path before it.
            time_ns: Time of the middle of the sweep.
            T_world_guess: (4, 4) where the matcher begins; None is the predicted pose.
        """
        motion = path.motion
        is_ruled_out = partial(motion.is_ruled_out, time_ns)
        scan = _Scan(
            deskewed, motion.predicted(time_ns), motion.spread(time_ns), is_ruled_out, path.sure_scans
        )
        found = self._track(scan, path.keyframes, T_world_guess)
        if found is None or (not self._believes_all and self._assessment.is_suspect(found)):
            found = self._search(scan, path, found)
        return None if found is None or self._assessment.is_lost(found) else found

    def _track(
        self, scan: _Scan, keyframes: Sequence[ScanKeyframe], T_world_guess: Transform | None
    ) -> PoseCandidate | None:
        """Match a scan near the prediction, and compare the pose with the keyframe that shows most of it."""
        T_world_begin = scan.T_world_predicted if T_world_guess is None else T_world_guess
        T_world_near = self._matcher.match(scan.deskewed, T_world_begin, reach="near")
        best: PoseCandidate | None = None
        for keyframe in keyframes:
            near = self._candidate(scan, _Hypothesis(T_world_near, keyframe, 0, "map"))
            if near is not None and self._believes_all:
                return near
            if near is not None and near.is_measured and not self._assessment.is_suspect(near):
                return near
            best = self._preferred(best, near)
        return best

    def _search(self, scan: _Scan, path: KnownPath, tracked: PoseCandidate | None) -> PoseCandidate | None:
        """Return the best of the hypotheses, those that need no guess only if none of the others fits."""
        description = described(scan.deskewed)
        candidates = [] if tracked is None else [_compare_both(tracked, description)]
        answers = Answers(scan.deskewed.prepared.voxel_m, [c.T_world_middle for c in candidates])

        def try_all(hypotheses: Iterable[_Hypothesis]) -> bool:
            """Add the candidates of some hypotheses until one is enough; return whether one is."""
            for hypothesis in hypotheses:
                T_world_middle = hypothesis.T_world_middle
                if T_world_middle is not None and answers.add(T_world_middle, hypothesis.guess):
                    candidate = self._candidate(scan, hypothesis)
                    if candidate is not None:
                        candidates.append(_compare_both(candidate, description))
                best = _best(candidates)
                if best is not None and self._is_enough(best, answers):
                    return True
            return False

        if not try_all(self._nearby(scan, path)) and not any(map(self._assessment.fits, candidates)):
            try_all(self._globally(scan, path))
        return _best(candidates)

    def _candidate(self, scan: _Scan, hypothesis: _Hypothesis) -> PoseCandidate | None:
        """Return a hypothesis with its fit, fused with the prediction; None if it is none, or cannot be."""
        keyframe, T_world_found = hypothesis.keyframe, hypothesis.T_world_middle
        if T_world_found is None or scan.is_ruled_out(T_world_found):
            return None
        T_key_scan = inverse(keyframe.T_world_middle) @ T_world_found
        fit = fit_of(
            keyframe, scan.deskewed, T_key_scan, max_pair_distance_m=self._config.max_pair_distance_m
        )
        if fit is None:
            return None
        T_world_middle, open_m = T_world_found, np.zeros(6)
        if not self._believes_all:
            T_world_middle, open_m = fuse_with_prediction(
                fit,
                scan.T_world_predicted,
                T_world_found,
                scan.spread,
                voxel_m=scan.deskewed.prepared.voxel_m,
            )
        if scan.deskewed.scan.is_planar:
            T_world_middle = in_plane(T_world_middle)
            fit = self._fit_again(scan, keyframe, fit, T_world_found, T_world_middle)
        jump = jump_between(scan.T_world_predicted, T_world_middle, scan.spread)
        shares = self._shares_of(fit, scan, keyframe, T_world_found)
        return PoseCandidate(keyframe, T_world_middle, fit, shares, jump, open_m, hypothesis.method)

    def _shares_of(
        self, fit: ScanFit, scan: _Scan, keyframe: ScanKeyframe, T_world_middle: Transform
    ) -> Shares:
        """Return the shares on all sure scans; on one in doubt alone, and of planar scans on the keyframe."""
        overlap, agreement = fit.overlap, fit.agreement
        if not fit.is_planar and any(one is keyframe for one in scan.before):
            others = [one for one in scan.before if one is not keyframe]
            reach_m = self._config.max_pair_distance_m
            overlap, agreement = shares_on(
                fit, others, scan.deskewed, T_world_middle, max_pair_distance_m=reach_m
            )
        return Shares(overlap, agreement, fit.contradicting)

    def _fit_again(
        self,
        scan: _Scan,
        keyframe: ScanKeyframe,
        fit: ScanFit,
        T_world_found: Transform,
        T_world_middle: Transform,
    ) -> ScanFit:
        """Return the fit at the pose that the wheels made of another one, if it is far from that."""
        moved_m, turned_rad = length_and_angle(inverse(T_world_found) @ T_world_middle)
        farther_m = self._config.max_pair_distance_m
        if moved_m < farther_m and turned_rad < _SAME_RAD:
            return fit
        T_key_scan = inverse(keyframe.T_world_middle) @ T_world_middle
        return fit_of(keyframe, scan.deskewed, T_key_scan, max_pair_distance_m=farther_m) or fit

    def _preferred(self, one: PoseCandidate | None, other: PoseCandidate | None) -> PoseCandidate | None:
        """Return the one that is less suspect and whose keyframe shows more of the motion."""
        if one is None or other is None:
            return one or other

        def rank(candidate: PoseCandidate) -> tuple[bool, float, float]:
            fit = candidate.fit
            shown = float(fit.observability.min()), float(fit.degeneracy.shares[0])
            return not self._assessment.is_suspect(candidate), *shown

        return other if rank(other) > rank(one) else one

    def _is_enough(self, best: PoseCandidate, answers: "Answers") -> bool:
        """Return whether no other pose has to be tried: it fits well, or several guesses lead to it."""
        median = self._assessment.statistics.median.score
        if best.score >= _GOOD * median and not self._assessment.is_suspect(best):
            return True
        return best.score >= _FAIR * median and answers.guesses_of(best.T_world_middle) >= _GUESSES

    def _nearby(self, scan: _Scan, path: KnownPath) -> Iterator[_Hypothesis]:
        """Yield poses that are found from the predicted one, from no motion, and from turns of both."""
        deskewed, T_world_predicted = scan.deskewed, scan.T_world_predicted
        up = T_world_predicted[2, :3]
        turned = [T_world_predicted @ exp(turn * up, np.zeros(3)) for turn in _TURNS_RAD]
        distances_m = [k * self._config.max_pair_distance_m for k in _PAIR_DISTANCES]
        for keyframe in _ends(path):
            far = self._matcher.match(deskewed, T_world_predicted, reach="far")
            yield _Hypothesis(far, keyframe, 0, "far")
            for guess, T_world_guess in enumerate((T_world_predicted, *turned, path.motion.T_world_last)):
                if self._matcher.uses_guess and guess > 0:  # from the predicted pose it was the first try
                    near = self._matcher.match(deskewed, T_world_guess, reach="near")
                    yield _Hypothesis(near, keyframe, guess, "turned")
                for target in (keyframe, path.last) if path.last is not None else (keyframe,):
                    T_target_scan = refined_motion(
                        target.deskewed.prepared,
                        deskewed.prepared,
                        inverse(target.T_world_middle) @ T_world_guess,
                        kind="gicp" if deskewed.scan.is_planar else "plane-icp",  # planes leave tilt open
                        pair_distances_m=distances_m,
                    )
                    if not isinstance(T_target_scan, str):
                        T_world_found = target.T_world_middle @ T_target_scan
                        method = "keyframe" if target is keyframe else "scan"
                        near = self._matcher.match(deskewed, T_world_found, reach="near")
                        yield _Hypothesis(near, keyframe, guess, method)
                        yield _Hypothesis(T_world_found, keyframe, guess, method)

    def _globally(self, scan: _Scan, path: KnownPath) -> Iterator[_Hypothesis]:
        """Yield the poses that are found without a guess."""
        if self._rescue is None:
            return
        for keyframe in _ends(path):
            if self._rescuer is None or self._rescuer[0] is not keyframe.deskewed:
                self._rescuer = keyframe.deskewed, aligner_to(keyframe.deskewed.scan, self._rescue)
            found = self._rescuer[1].align(scan.deskewed.scan, np.eye(4))
            if found.converged:
                T_world_found = keyframe.T_world_middle @ found.T_target_source
                near = self._matcher.match(scan.deskewed, T_world_found, reach="near")
                yield _Hypothesis(near, keyframe, len(_TURNS_RAD) + 2, "rescued")
                yield _Hypothesis(T_world_found, keyframe, len(_TURNS_RAD) + 2, "rescued")


def _ends(path: KnownPath) -> Sequence[ScanKeyframe]:
    """Return the keyframes that a scan may continue from."""
    return (path.keyframes[0],) if path.doubtful is None else (path.keyframes[0], path.doubtful)


def _compare_both(candidate: PoseCandidate, description: ScanDescription) -> PoseCandidate:
    """Return a candidate with the contradictions of both scans."""
    T_key_scan = inverse(candidate.keyframe.T_world_middle) @ candidate.T_world_middle
    share = contradiction(candidate.keyframe, description, T_key_scan)
    return replace(candidate, shares=replace(candidate.shares, contradicting=share))


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
            apart_m, turned_rad = length_and_angle(inverse(other) @ T_world_body)
            if apart_m < self._near_m and turned_rad < _SAME_RAD:
                return guesses
        return None


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
    """Return the jump in units of its limits, or of 1 m and 1 rad where that is unknown."""
    jump = candidate.jump
    if not np.isfinite(jump.limit_m):
        return jump.translation_m + jump.rotation_rad
    return max(jump.translation_m / jump.limit_m, jump.rotation_rad / jump.limit_rad)
