"""Acceptance of a Hough registration's answer: why it is refused, if it is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Transform, angle_between
from mapper.registration.base import Alignment
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.free_space import FreeSpaceResult
from mapper.registration.hough.config import HoughConfig
from mapper.registration.hough.description import HoughDescription
from mapper.registration.surfaces import Prepared

MIN_CENTRES = 5
"""A scan with fewer centres shows no objects."""
MIN_SCORE = 0.0
"""A best candidate with a lower score is refused without being refined. Right ones had 0.3 and more, those of
different streets −0.4 and less."""
MIN_GROUND_RATIO = 0.15
"""Share of a scan's ground that the other scan measured, too. Where two views have but a wall in common, any
wall
fits: wrong answers that nothing contradicted had 0.07 and less, right ones 0.31 and more."""
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
        free_space: Free-space check of the obstacles.
        ground_ratio: Share of the ground on surfaces that the other scan measured; the larger of both scans'.
    """

    T_target_source: Transform
    free_space: FreeSpaceResult
    ground_ratio: float

    @property
    def agreeing_ratio(self) -> float:
        """Share of obstacles that agree, the smaller of both scans'."""
        return min(self.free_space.source.agreeing_ratio, self.free_space.target.agreeing_ratio)

    @property
    def contradicting_ratio(self) -> float:
        """Share of obstacles that contradict, the mean of both scans'."""
        return 0.5 * (self.free_space.source.contradicting_ratio + self.free_space.target.contradicting_ratio)

    @property
    def score(self) -> float:
        """Mean share that agrees, less the weighted mean share that contradicts."""
        agreeing = 0.5 * (self.free_space.source.agreeing_ratio + self.free_space.target.agreeing_ratio)
        return agreeing - CONTRADICTION_WEIGHT * self.contradicting_ratio

    def gap_to(self, other: "Candidate") -> tuple[float, float]:
        """Return how far two motions place the source apart, in metres and radians."""
        gap_m = float(np.linalg.norm(self.T_target_source[:3, 3] - other.T_target_source[:3, 3]))
        return gap_m, angle_between(self.T_target_source[:3, :3], other.T_target_source[:3, :3])


def too_few_centres(target: HoughDescription, source: HoughDescription) -> str:
    """Return which scan has too few centres to vote with; empty if none has."""
    for name, side in (("target", target), ("source", source)):
        if (count := len(side.centres_level)) < MIN_CENTRES:
            return f"{name}: {count} objects stand on the ground, fewer than {MIN_CENTRES}"
    return ""


def hopeless(best: Candidate) -> str:
    """Return why the best verified candidate is not worth refining; empty if it is."""
    if best.score >= MIN_SCORE:
        return ""
    return (
        f"under the best motion {best.agreeing_ratio:.0%} of a scan's obstacles are where the other "
        f"saw any, and {best.contradicting_ratio:.0%} where it looked through: different places"
    )


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


def degenerate(alignment: Alignment, source: Prepared) -> str:
    """Return which motions the refined clouds leave unobservable; empty if none."""
    assert alignment.information is not None  # it converged
    degeneracy = degeneracy_of(alignment.information, points=source.points)
    return f"degenerate: no surface shows {degeneracy.text}" if degeneracy.is_degenerate else ""
