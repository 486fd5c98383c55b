"""Registration without a first guess: Hough voting, verified, then refined (Nagy, Gálai & Benedek 2016)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Transform, angle_between, inverse
from mapper.registration.base import Alignment, failed
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.free_space import FreeSpaceCheck, FreeSpaceResult
from mapper.registration.hough.config import HoughConfig
from mapper.registration.hough.description import HoughDescription, describe
from mapper.registration.hough.refinement import (
    PlanarFit,
    RefinementCloud,
    align_grounds,
    refine_on_points,
    refine_planar,
    refinement_cloud,
)
from mapper.registration.hough.voting import Peak, distinct, vote
from mapper.registration.pair_refinement import measured
from mapper.runtime.progress import Stopwatch

MIN_CENTRES = 5
"""A scan with fewer centres shows no objects."""
MIN_GROUND_RATIO = 0.15
"""Share of a scan's ground that the other scan measured, too. Where two views have but a wall in common, any
wall fits: wrong answers that nothing contradicted had 0.07 and less, right ones 0.31 and more."""
MAX_CONTRADICTING_RATIO = 0.015
"""Share of the obstacles in the other scan's free space, the mean of both. Right answers had 0.008 and less,
or 0.014 where a cloud's origin was not where its rays began; answers in other, similar courtyards 0.016 and
more."""
MANY_CENTRES = 150
MAX_CONTRADICTING_RATIO_OF_MANY = 0.03
"""The same where both scans have many centres, whose agreement is no chance: traffic may contradict more.
Right answers had 0.023 and less, wrong ones 0.1 and more."""
_CHECKED, _REFINED = 6, 3
"""Peaks, those with most overlap, that get the free-space check, and candidates of like score that are
refined."""
_DISTINCT_RAD = 0.05
_MIN_LEAD = 0.1
"""Least lead of the answer's score over that of any other motion."""
CONTRADICTION_WEIGHT = 5.0
"""A motion's score is the share of obstacles that agree, less this multiple of the share that contradicts."""
NEAR_SCORE = 0.3
"""Candidates are refined whose scores are this near to the best."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A motion between the two body frames, and how the scans fit each other under it.

    Attributes:
        T_target_source: (4, 4) the motion.
        obstacles: Free-space check of the obstacles.
        ground: Free-space check of the ground.
    """

    T_target_source: Transform
    obstacles: FreeSpaceResult
    ground: FreeSpaceResult

    @property
    def agreeing_ratio(self) -> float:
        """Share of obstacles that agree, the smaller of both scans'."""
        return min(self.obstacles.source.agreeing_ratio, self.obstacles.target.agreeing_ratio)

    @property
    def contradicting_ratio(self) -> float:
        """Share of obstacles that contradict, the mean of both scans'."""
        return 0.5 * (self.obstacles.source.contradicting_ratio + self.obstacles.target.contradicting_ratio)

    @property
    def ground_ratio(self) -> float:
        """Share of the ground on surfaces that the other scan measured, the larger of both scans'."""
        return max(self.ground.source.agreeing_ratio, self.ground.target.agreeing_ratio)

    @property
    def score(self) -> float:
        """Mean share that agrees, less the weighted mean share that contradicts."""
        agreeing = 0.5 * (self.obstacles.source.agreeing_ratio + self.obstacles.target.agreeing_ratio)
        return agreeing - CONTRADICTION_WEIGHT * self.contradicting_ratio

    def gap_to(self, other: "Candidate") -> tuple[float, float]:
        """Return how far two motions place the source apart, in metres and radians."""
        gap_m = float(np.linalg.norm(self.T_target_source[:3, 3] - other.T_target_source[:3, 3]))
        return gap_m, angle_between(self.T_target_source[:3, :3], other.T_target_source[:3, :3])


def rejection(
    best: Candidate, refined: Sequence[Candidate], config: HoughConfig, *, fewest_centres: int
) -> str:
    """Return why the best refined candidate is refused; empty if it is accepted.

    Args:
        best: The candidate.
        refined: All refined candidates; one far from the best that scores nearly as high makes it ambiguous.
        config: Thresholds, and how near two motions are the same.
        fewest_centres: Number of centres of the scan that has fewer.
    """
    acceptance, overlap = config.acceptance, config.overlap
    max_contradicting_ratio = (
        MAX_CONTRADICTING_RATIO if fewest_centres < MANY_CENTRES else MAX_CONTRADICTING_RATIO_OF_MANY
    )
    if best.agreeing_ratio < acceptance.min_agreeing_ratio:
        return (
            f"{best.agreeing_ratio:.0%} of a scan's obstacles are where the other saw any, "
            f"less than {acceptance.min_agreeing_ratio:.0%}: the clouds hardly overlap"
        )
    if best.ground_ratio < MIN_GROUND_RATIO:
        return (
            f"{best.ground_ratio:.0%} of the ground is where the other scan saw it, "
            f"less than {MIN_GROUND_RATIO:.0%}: the clouds hardly overlap"
        )
    if best.contradicting_ratio > max_contradicting_ratio:
        return (
            f"{best.contradicting_ratio:.1%} of the obstacles are where the other scan looked through, "
            f"more than {max_contradicting_ratio:.1%}"
        )
    for other in refined:
        if best.score - other.score >= _MIN_LEAD or other.ground_ratio < MIN_GROUND_RATIO:
            continue
        gap_m, turn_rad = best.gap_to(other)
        if gap_m > overlap.distinct_m or turn_rad > _DISTINCT_RAD:
            return (
                f"ambiguous: a motion {gap_m:.1f} m and {np.degrees(turn_rad):.0f}° away scores "
                f"{other.score:.2f}, within {_MIN_LEAD:g} of the best"
            )
    return ""


@dataclass(frozen=True, slots=True, eq=False)
class Stages:
    """A registration, step by step.

    Attributes:
        peaks: Peaks of the accumulator, the highest first.
        hough: The verified candidate with the best score; None where there is none.
        refined: The refined candidate with the best score; None where none was refined.
        alignment: The answer.
        seconds: Wall time of each step, in order.
    """

    peaks: list[Peak]
    hough: Candidate | None
    refined: Candidate | None
    alignment: Alignment
    seconds: dict[str, float]


class Hough:
    """Hough registration: scans are aligned to a target by the centres of what stands around them."""

    def __init__(self, target: Scan, config: HoughConfig) -> None:
        self._config = config
        self._check = FreeSpaceCheck(config.overlap.margin_m)
        self._target = describe(target, config)
        self._cloud = refinement_cloud(target, self._target, config)

    def align(self, source: Scan, T_target_source: Transform) -> Alignment:  # noqa: ARG002
        """Return the motion of a source, whatever the guess."""
        return self.stages(source).alignment

    def stages(self, source: Scan) -> Stages:
        """Return the motion of a source, and how it was found."""
        watch = Stopwatch()
        target, config = self._target, self._config
        with watch.stage("describe"):
            description = describe(source, config)
        for name, side in (("target", target), ("source", description)):
            if (count := len(side.centres_level)) < MIN_CENTRES:
                reason = f"{name}: {count} objects stand on the ground, fewer than {MIN_CENTRES}"
                return Stages([], None, None, failed(reason), watch.seconds)
        with watch.stage("vote"):
            peaks = vote(target.centres_level, description.centres_level, config.voting)
        with watch.stage("verify"):
            candidates = self._verified(description, peaks)
        if not candidates:
            reason = "no offset within the accumulator joins any two centres"
            return Stages(peaks, None, None, failed(reason), watch.seconds)
        hough = candidates[0]
        if hough.score < 0.0:  # right ones had 0.3 and more, those of different streets −0.4 and less
            reason = (
                f"under the best motion {hough.agreeing_ratio:.0%} of a scan's obstacles are where the other "
                f"saw any, and {hough.contradicting_ratio:.0%} where it looked through: different places"
            )
            return Stages(peaks, hough, None, failed(reason), watch.seconds)
        with watch.stage("prepare source"):
            cloud = refinement_cloud(source, description, config)
        with watch.stage("refine"):
            refined, reason = self._refined(description, cloud, candidates)
            best = max(refined, key=lambda candidate: candidate.score, default=None)
            alignment = failed(reason) if best is None else self._assessed(description, cloud, best, refined)
        return Stages(peaks, hough, best, alignment, watch.seconds)

    def _verified(self, source: HoughDescription, peaks: Sequence[Peak]) -> list[Candidate]:
        """Return the distinct motions near the peaks that overlap most, the best score first."""
        config, target, overlap = self._config, self._target, self._config.overlap
        fits = [refine_planar(target, source, (p.dx_m, p.dy_m, p.alpha_rad), config) for p in peaks]
        fits.sort(key=lambda fit: -fit.overlap)
        chosen = distinct(
            np.array([(fit.dx_m, fit.dy_m) for fit in fits]).reshape(-1, 2),
            np.array([fit.alpha_rad for fit in fits]),
            _CHECKED,
            far_m=overlap.distinct_m,
            far_rad=_DISTINCT_RAD,
        )
        candidates = [self._candidate(source, self._in_space(source, fits[k])) for k in chosen]
        return sorted(candidates, key=lambda candidate: -candidate.score)

    def _in_space(self, source: HoughDescription, fit: PlanarFit) -> Transform:
        T_level_level = align_grounds(self._target.ground, source.ground, fit)
        return inverse(self._target.T_level_body) @ T_level_level @ source.T_level_body

    def _candidate(self, source: HoughDescription, T_target_source: Transform) -> Candidate:
        target, compare = self._target, self._check.compare
        return Candidate(
            T_target_source,
            compare(target.checked_obstacles, source.checked_obstacles, T_target_source),
            compare(target.checked_ground, source.checked_ground, T_target_source),
        )

    def _refined(
        self, source: HoughDescription, cloud: RefinementCloud, candidates: Sequence[Candidate]
    ) -> tuple[list[Candidate], str]:
        """Return the refined candidates, or why there are none."""
        refined: list[Candidate] = []
        reason = ""
        rivals = [c for c in candidates if c.score >= candidates[0].score - NEAR_SCORE]
        for rival in rivals[:_REFINED]:
            found = refine_on_points(self._cloud, cloud, rival.T_target_source, self._config)
            if isinstance(found, str):
                reason = found
            else:
                refined.append(self._candidate(source, found))
        return refined, reason

    def _assessed(
        self, source: HoughDescription, cloud: RefinementCloud, best: Candidate, refined: Sequence[Candidate]
    ) -> Alignment:
        """Return the best refined candidate as an alignment; not converged when it is refused."""
        alignment = measured(
            self._cloud.thinned,
            cloud.thinned,
            best.T_target_source,
            max_pair_distance_m=self._config.acceptance.pair_m,
        )
        if not alignment.converged:
            return alignment
        fewest_centres = min(len(self._target.centres_level), len(source.centres_level))
        reason = rejection(best, refined, self._config, fewest_centres=fewest_centres)
        if not reason:
            assert alignment.information is not None  # it converged
            reason = degeneracy_of(alignment.information, points=cloud.thinned.points).reason
        return replace(alignment, converged=not reason, reason=reason)
