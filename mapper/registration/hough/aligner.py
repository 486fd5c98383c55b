"""Registration without a first guess: Hough voting, verified, then refined (Nagy, Gálai & Benedek 2016)."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from mapper.core.frames import Scan
from mapper.core.geometry import Transform, inverse
from mapper.registration.base import Alignment, failed
from mapper.registration.free_space import FreeSpaceCheck
from mapper.registration.hough.acceptance import (
    Candidate,
    degenerate,
    hopeless,
    rejection,
    too_few_centres,
)
from mapper.registration.hough.config import HoughConfig
from mapper.registration.hough.description import HoughDescription, describe
from mapper.registration.hough.planar_refinement import PlanarFit, align_grounds, refine_planar
from mapper.registration.hough.point_refinement import RefinementCloud, refine_on_points, refinement_cloud
from mapper.registration.hough.voting import Peak, vote
from mapper.registration.refining import measured

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
        clock = _Clock()
        config = self._config
        description = describe(source, config)
        clock.lap("describe")
        if reason := too_few_centres(self._target, description):
            return Stages([], None, None, failed(reason), clock.seconds)
        peaks = vote(self._target.centres_level, description.centres_level, config.voting)
        clock.lap("vote")
        candidates = self._verified(description, peaks)
        clock.lap("verify")
        if not candidates:
            reason = "no offset within the accumulator joins any two centres"
            return Stages(peaks, None, None, failed(reason), clock.seconds)
        if reason := hopeless(candidates[0]):
            return Stages(peaks, candidates[0], None, failed(reason), clock.seconds)
        cloud = refinement_cloud(source, description, config)
        clock.lap("prepare source")
        refined, reason = self._refined(description, cloud, candidates)
        best = max(refined, key=lambda candidate: candidate.score, default=None)
        alignment = failed(reason) if best is None else self._assessed(description, cloud, best, refined)
        clock.lap("refine")
        return Stages(peaks, candidates[0], best, alignment, clock.seconds)

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
        return inverse(self._target.free_space.T_level_body) @ T_level_level @ source.free_space.T_level_body

    def _candidate(self, source: HoughDescription, T_target_source: Transform) -> Candidate:
        target, check = self._target, self._check
        T_target_level = T_target_source @ inverse(source.free_space.T_level_body)
        T_source_level = inverse(T_target_source) @ inverse(target.free_space.T_level_body)
        return Candidate(
            T_target_source,
            check.compare(target.free_space, source.free_space, T_target_source),
            ground_ratio=max(
                check.count(target.free_space, source.ground_level, T_target_level).agreeing_ratio,
                check.count(source.free_space, target.ground_level, T_source_level).agreeing_ratio,
            ),
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
        reason = reason or degenerate(alignment, cloud.thinned)
        return replace(alignment, converged=not reason, reason=reason)


class _Clock:
    """Wall seconds from lap to lap."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, name: str) -> None:
        """Note the time since the last lap under a name."""
        now = time.perf_counter()
        self.seconds[name] = now - self._since
        self._since = now
