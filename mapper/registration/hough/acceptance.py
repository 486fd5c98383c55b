"""Acceptance of a Hough registration's answer: why it is refused, if it is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Transform, angle_between
from mapper.registration.free_space import FreeSpaceResult
from mapper.registration.hough.config import HoughConfig

MIN_CENTRES = 5
"""A scan with fewer centres shows no objects."""
MIN_SCORE = 0.0
"""A best candidate with a lower score is refused without being refined. Right ones had 0.3 and more, those of
different streets −0.4 and less."""
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
CONTRADICTION_WEIGHT = 5.0
"""A motion's score is the share of obstacles that agree, less so many times the share that contradicts."""


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
        if best.score - other.score >= acceptance.min_lead or other.ground_ratio < MIN_GROUND_RATIO:
            continue
        gap_m, turn_rad = best.gap_to(other)
        if gap_m > overlap.distinct_m or turn_rad > overlap.distinct_rad:
            return (
                f"ambiguous: a motion {gap_m:.1f} m and {np.degrees(turn_rad):.0f}° away scores "
                f"{other.score:.2f}, within {acceptance.min_lead:g} of the best"
            )
    return ""
