"""Registration without a first guess: Hough voting, verified, then refined (Nagy, Gálai & Benedek 2016)."""

import time
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Points, Transform, angle_between, inverse
from mapper.registration.base import Alignment, failed
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.hough.config import GicpStagesConfig, HoughConfig, NdtStagesConfig
from mapper.registration.hough.overlap import (
    Overlap,
    PlanarFit,
    Witness,
    overlap_under,
    refine_planar,
    settled,
    witness,
)
from mapper.registration.hough.voting import Peak, vote
from mapper.registration.ndt import refine_by_cells
from mapper.registration.refining import measured, refined_motion
from mapper.registration.surfaces import Prepared, prepared


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A motion between the two body frames, and how it fits what they saw."""

    T_target_source: Transform
    overlap: Overlap
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Stages:
    """A registration, step by step.

    Attributes:
        peaks: Of the accumulator, the highest first.
        hough: The verified candidate with the best score; None where there is none.
        alignment: The answer.
        overlap: Of the answer, or of the candidate where that was not refined; None without either.
        seconds: Wall time of each step, in order.
    """

    peaks: list[Peak]
    hough: Candidate | None
    alignment: Alignment
    overlap: Overlap | None
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """A scan's points, ready to be refined and judged.

    Attributes:
        thinned: One point per voxel, with normals.
        dense: (N, 3) what makes NDT's cells, metres, body frame; empty for GICP.
        sparse: (M, 3) what is placed in them.
        refinement: Which of the two.
    """

    thinned: Prepared
    dense: Points
    sparse: Points
    refinement: GicpStagesConfig | NdtStagesConfig

    def refined(self, source: "Cloud", T_target_source: Transform) -> Transform | str:
        """Return the motion refined from a guess, with this as the target, or why there is none."""
        refinement = self.refinement
        if isinstance(refinement, NdtStagesConfig):
            for cell_m in refinement.cells_m:
                found = refine_by_cells(
                    self.dense,
                    source.sparse,
                    T_target_source,
                    cell_m=cell_m,
                    min_points=refinement.min_points,
                    max_iterations=refinement.max_iterations,
                )
                if isinstance(found, str):
                    return found
                T_target_source = found
            return T_target_source
        for distance_m in refinement.pair_distances_m:
            found = refined_motion(
                self.thinned,
                source.thinned,
                T_target_source,
                kind="gicp",
                max_pair_distance_m=distance_m,
                max_iterations=refinement.max_iterations,
            )
            if isinstance(found, str):
                return found
            T_target_source = found
        return T_target_source


def cloud_of(scan: Scan, seen: Witness, config: HoughConfig) -> Cloud:
    """Return a scan's points as its method wants them."""
    thinned = prepared(scan.points_body, voxel_m=config.voxel_m, neighbours=config.neighbours)
    dense = sparse = np.empty((0, 3))
    if isinstance(config.refinement, NdtStagesConfig):
        dense, sparse = scan.points_body.astype(np.float64), thinned.points
        if not config.refinement.with_ground:
            least_m = config.constellation.ground.max_thickness_m
            dense, sparse = seen.above_ground(dense, least_m), seen.above_ground(sparse, least_m)
    return Cloud(thinned, dense, sparse, config.refinement)


class Hough:
    """Registers scans by the constellations of what stands around them."""

    def __init__(self, config: HoughConfig) -> None:
        self._config = config

    def prepare(self, target: Scan) -> "HoughAligner":
        """Return the method bound to a target."""
        return HoughAligner(target, self._config)


class HoughAligner:
    """A target's level, constellation, obstacles and cloud."""

    def __init__(self, target: Scan, config: HoughConfig) -> None:
        self._config = config
        self._target = witness(target, config)
        self._cloud = cloud_of(target, self._target, config)

    def align(self, source: Scan, T_target_source: Transform) -> Alignment:  # noqa: ARG002
        """Return the motion of a source, whatever the guess."""
        return self.stages(source).alignment

    def stages(self, source: Scan) -> Stages:
        """Return the motion of a source, and how it was found."""
        clock = _Clock()
        config, target = self._config, self._target
        seen = witness(source, config)
        clock.lap("describe")
        reason = self._too_little(seen)
        if reason:
            return Stages([], None, failed(reason), None, clock.seconds)
        peaks = vote(target.centres_level, seen.centres_level, config.voting)
        clock.lap("vote")
        candidates = self._verified(seen, peaks)
        clock.lap("verify")
        if not candidates:
            reason = "no offset within the accumulator joins any two centres"
            return Stages(peaks, None, failed(reason), None, clock.seconds)
        best = candidates[0]
        if best.score < config.trust.min_score:
            reason = (
                f"under the best motion {best.overlap.agree:.0%} of a scan's obstacles are where the other "
                f"saw any, and {best.overlap.through:.0%} where it looked through: different places"
            )
            return Stages(peaks, best, failed(reason), best.overlap, clock.seconds)
        cloud = cloud_of(source, seen, config)
        clock.lap("prepare source")
        alignment, overlap = self._refined(seen, cloud, candidates)
        clock.lap("refine")
        return Stages(peaks, best, alignment, overlap, clock.seconds)

    def _too_little(self, source: Witness) -> str:
        """Return why there is nothing to vote for, or nothing."""
        for name, side in (("target", self._target), ("source", source)):
            count, least = len(side.centres_level), self._config.trust.min_centres
            if count < least:
                return f"{name}: {count} objects stand on the ground, fewer than {least}"
        return ""

    def _verified(self, source: Witness, peaks: list[Peak]) -> list[Candidate]:
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

    def _in_space(self, source: Witness, fit: PlanarFit) -> Transform:
        T_level_level = settled(self._target.ground, source.ground, fit)
        return inverse(self._target.T_level_body) @ T_level_level @ source.T_level_body

    def _candidate(self, source: Witness, T_target_source: Transform) -> Candidate:
        overlap = overlap_under(self._target, source, T_target_source, self._config.overlap)
        score = overlap.score(self._config.overlap.contradiction_weight)
        return Candidate(T_target_source, overlap, score)

    def _refined(
        self, source: Witness, cloud: Cloud, candidates: list[Candidate]
    ) -> tuple[Alignment, Overlap | None]:
        """Return the refined candidate with the best score, judged, and how it fits."""
        trust = self._config.trust
        rivals = [c for c in candidates if c.score >= candidates[0].score - trust.near_score]
        refined: list[Candidate] = []
        reason = ""
        for rival in rivals[: trust.refined]:
            found = self._cloud.refined(cloud, rival.T_target_source)
            if isinstance(found, str):
                reason = found
            else:
                refined.append(self._candidate(source, found))
        if not refined:
            return failed(reason), None
        best = max(refined, key=lambda candidate: candidate.score)
        alignment = measured(
            self._cloud.thinned,
            cloud.thinned,
            best.T_target_source,
            max_pair_distance_m=trust.pair_m,
        )
        if alignment.converged:
            reason = self._doubt(best, refined, self._tolerance(source)) or self._looseness(cloud, alignment)
            alignment = replace(alignment, converged=not reason, reason=reason)
        return alignment, best.overlap

    def _tolerance(self, source: Witness) -> float:
        """Return the share of obstacles that may contradict an answer."""
        trust = self._config.trust
        fewest = min(len(self._target.centres_level), len(source.centres_level))
        if fewest < trust.many_centres:
            return trust.max_contradicting_ratio
        return trust.max_contradicting_many_ratio

    def _doubt(self, best: Candidate, others: list[Candidate], max_contradicting: float) -> str:
        """Return why the best candidate is not to be believed, or nothing."""
        trust, overlap = self._config.trust, best.overlap
        if overlap.agree < trust.min_agreeing_ratio:
            return (
                f"{overlap.agree:.0%} of a scan's obstacles are where the other saw any, "
                f"less than {trust.min_agreeing_ratio:.0%}: the clouds hardly overlap"
            )
        if overlap.ground < trust.min_ground_ratio:
            return (
                f"{overlap.ground:.0%} of the ground is where the other scan saw it, "
                f"less than {trust.min_ground_ratio:.0%}: the clouds hardly overlap"
            )
        if overlap.through > max_contradicting:
            return (
                f"{overlap.through:.1%} of the obstacles are where the other scan looked through, "
                f"more than {max_contradicting:.1%}"
            )
        for other in others:
            if (
                best.score - other.score < trust.min_lead
                and other.overlap.ground >= trust.min_ground_ratio
                and not self._is_near(best, other)
            ):
                gap_m, turn_rad = _gap(best, other)
                return (
                    f"ambiguous: a motion {gap_m:.1f} m and {np.degrees(turn_rad):.0f}° away scores "
                    f"{other.score:.2f}, within {trust.min_lead:g} of the best"
                )
        return ""

    def _looseness(self, cloud: Cloud, alignment: Alignment) -> str:
        """Return which motions the refined clouds leave open, or nothing."""
        assert alignment.information is not None  # measured and converged
        degeneracy = degeneracy_of(
            alignment.information,
            points=cloud.thinned.points,
            min_share=self._config.trust.min_share,
        )
        return f"degenerate: no surface shows {degeneracy.text}" if degeneracy.is_degenerate else ""

    def _is_near(self, a: Candidate, b: Candidate) -> bool:
        """Tell whether two candidates are the same motion."""
        gap_m, turn_rad = _gap(a, b)
        overlap = self._config.overlap
        return gap_m <= overlap.distinct_m and turn_rad <= overlap.distinct_rad


def _gap(a: Candidate, b: Candidate) -> tuple[float, float]:
    """Return how far two motions place the source apart, in metres and radians."""
    gap_m = float(np.linalg.norm(a.T_target_source[:3, 3] - b.T_target_source[:3, 3]))
    return gap_m, angle_between(a.T_target_source[:3, :3], b.T_target_source[:3, :3])


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
