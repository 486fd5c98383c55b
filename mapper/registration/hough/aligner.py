"""Registration without a first guess: Hough voting, verified, then refined (Nagy, Gálai & Benedek 2016)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mapper.core.frames import Scan
from mapper.core.geometry import Transform, inverse
from mapper.registration.base import Alignment, failed
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.free_space import FreeSpaceCheck
from mapper.registration.hough.acceptance import MIN_CENTRES, MIN_SCORE, Candidate, rejection
from mapper.registration.hough.config import HoughConfig
from mapper.registration.hough.description import HoughDescription, describe
from mapper.registration.hough.planar_refinement import PlanarFit, align_grounds, refine_planar
from mapper.registration.hough.point_refinement import RefinementCloud, refine_on_points, refinement_cloud
from mapper.registration.hough.voting import Peak, vote
from mapper.registration.refining import measured
from mapper.runtime.progress import Stopwatch

NEAR_SCORE = 0.3
"""Candidates are refined whose scores are this near to the best."""


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
    """Hough registration: scans are aligned by the centres of what stands around them."""

    def __init__(self, config: HoughConfig) -> None:
        self._config = config

    def prepare(self, target: Scan) -> "HoughAligner":
        """Return the method bound to a target."""
        return HoughAligner(target, self._config)


class HoughAligner:
    """Hough registration bound to a target: its description and its cloud."""

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
        if hough.score < MIN_SCORE:
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
        config, target = self._config, self._target
        fits = [refine_planar(target, source, (p.dx_m, p.dy_m, p.alpha_rad), config) for p in peaks]
        chosen: list[PlanarFit] = []
        for fit in sorted(fits, key=lambda fit: -fit.overlap):
            if len(chosen) < config.overlap.candidates and not any(
                fit.is_near(better, config.overlap) for better in chosen
            ):
                chosen.append(fit)
        candidates = [self._candidate(source, self._in_space(source, fit)) for fit in chosen]
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
        for rival in rivals[: self._config.acceptance.refined]:
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
