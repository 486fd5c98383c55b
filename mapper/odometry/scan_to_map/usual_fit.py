"""Fit that scans of this log usually have, and the evidence against a pose that fits less."""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.geometry import Transform, angle_between, inverse
from mapper.odometry.scan_to_map.motion_model import Spread

_RECENT = 30  # recent scans whose fits are usual
_SPREADS = 4.0  # so many standard deviations below its median a share is unusual
_FEW_SPREADS, _LITTLE = 2.0, 0.75
"""So many standard deviations below the median, at this part of it, make a search worth its time; this part
alone makes a pose less certain: on stairs such poses are off by 0.05 to 0.3 m."""
_NORMAL = 1.4826  # standard deviations in a median absolute deviation
_FEWEST = 5
_LEAST_AGREEMENT, _SEARCHED_AGREEMENT = 0.3, 0.6
"""Less than these parts of the usual one is unusual, and makes a search worth its time, however much the
scans of a log differ."""
_LEAST_OVERLAP_SPREAD = 0.04
_LEAST_AGREEMENT_SPREAD = 0.06
_MAX_CONTRADICTING, _TIMES_CONTRADICTING = 0.012, 4.0
"""Share of points in space that rays passed, none of them by a grazing ray: right poses have up to 0.007,
wrong ones 0.013 to 0.03 and more. It may be so many times the usual one where people or traffic move."""
_LEAST_SCORE = 0.1
"""Part of the usual score below which fewer contradictions are too many: scans 1.5 s apart had 0.6 and more
under right poses, and less than 0 under wrong ones. 0 serves as well; with 0.25 right scans are doubtful."""
_LEAST_WIDE_SCORE = 0.25
"""That part for poses of a wide search: all 3 below it that contradict were wrong by 3.5 to 7 degrees. 0.2
and 0.4 serve as well."""
_FIRST_SCANS, _FIRST_OVERLAP, _FIRST_AGREEMENT, _FIRST_SPREAD = 3, 0.7, 0.4, 1.5
"""The first scans of a map that all contradict, by shares within this factor of each other, while so much
overlaps and agrees, do so by rain, dust or a crowd: under wrong poses they agree less and differ more."""
_CONTRADICTION_WEIGHT = 15.0
_OTHER_PLACE, _HARDLY = 0.1, 0.2
_JUMP_SPREADS = 8.0
_LEAST_JUMP_M, _LEAST_JUMP_RAD = 0.15, 0.09


@dataclass(frozen=True, slots=True)
class Shares:
    """Shares of one scan's points under a pose, of as many as the keyframe's view can cover.

    Attributes:
        overlap: With a partner on the keyframe.
        agreement: On its surfaces, in the direction where the least agree.
        contradicting: In space that rays passed.
    """

    overlap: float
    agreement: float
    contradicting: float

    @property
    def score(self) -> float:
        """Agreement less what contradicts, weighted; overlap shows little, as ground lies on any ground."""
        return self.agreement - _CONTRADICTION_WEIGHT * self.contradicting


@dataclass(frozen=True, slots=True)
class Jump:
    """Deviation from the predicted pose, and how much would be unusual."""

    translation_m: float
    rotation_rad: float
    limit_m: float
    limit_rad: float

    @property
    def is_unusual(self) -> bool:
        """Whether it is more than the limits."""
        return self.translation_m > self.limit_m or self.rotation_rad > self.limit_rad

    @property
    def text(self) -> str:
        """Both in words."""
        return (
            f"jump of {self.translation_m:.2f} m and {np.degrees(self.rotation_rad):.0f}° from the predicted "
            f"pose, where {self.limit_m:.2f} m and {np.degrees(self.limit_rad):.0f}° would be much"
        )


def jump_between(T_world_predicted: Transform, T_world_found: Transform, spread: Spread | None) -> Jump:
    """Return how far a pose lies from the predicted one; without a known spread nothing is unusual."""
    error = inverse(T_world_predicted) @ T_world_found
    limits = (np.inf, np.inf)
    if spread is not None:
        limits = (
            max(_JUMP_SPREADS * spread.translation_m, _LEAST_JUMP_M),
            max(_JUMP_SPREADS * spread.rotation_rad, _LEAST_JUMP_RAD),
        )
    return Jump(float(np.linalg.norm(error[:3, 3])), angle_between(np.eye(3), error[:3, :3]), *limits)


class UsualFit:
    """Medians and spreads of the shares of recent scans that were tracked without doubt.

    Attributes:
        usual: Median shares; of a perfect fit without scans.
    """

    def __init__(self) -> None:
        self._recent: deque[Shares] = deque(maxlen=_RECENT)
        self._first: list[float] = []
        self.clear()

    def add(self, shares: Shares) -> None:
        """Add a scan's."""
        self._recent.append(shares)
        values = np.array([(s.overlap, s.agreement, s.contradicting) for s in self._recent])
        medians = np.median(values, axis=0)
        self.usual = Shares(*medians.tolist())
        if len(values) >= _FEWEST:
            spreads = _NORMAL * np.median(np.abs(values - medians), axis=0)
            self._overlap_spread = max(float(spreads[0]), _LEAST_OVERLAP_SPREAD)
            self._agreement_spread = max(float(spreads[1]), _LEAST_AGREEMENT_SPREAD)

    def add_doubtful(self, shares: Shares) -> None:
        """Add those of a doubtful scan: what contradicts alike in all first scans of a map is usual there.

        Doubtful scans do not enter the map, so a log of whose scans all contradict would never begin.
        """
        agrees = shares.overlap >= _FIRST_OVERLAP and shares.agreement >= _FIRST_AGREEMENT
        self._first = [*self._first, shares.contradicting] if agrees and self.contradicts(shares) else []
        if self.is_known or len(self._first) < _FIRST_SCANS:
            return
        if max(self._first) <= _FIRST_SPREAD * min(self._first):
            self.usual = replace(self.usual, contradicting=float(np.median(self._first)))

    def clear(self) -> None:
        """Forget all."""
        self._recent.clear()
        self._first = []
        self.usual = Shares(overlap=1.0, agreement=1.0, contradicting=0.0)
        self._overlap_spread, self._agreement_spread = _LEAST_OVERLAP_SPREAD, _LEAST_AGREEMENT_SPREAD

    @property
    def is_known(self) -> bool:
        """Whether any scan showed what is usual; until then poses are searched for, but none is doubted."""
        return bool(self._recent)

    def has_little_overlap(self, shares: Shares, *, usual_ratio: float) -> bool:
        """Return whether the overlap is below the log's spread, and this share of the usual one."""
        least = self.usual.overlap - _SPREADS * self._overlap_spread
        return shares.overlap < min(least, usual_ratio * self.usual.overlap)

    def disagrees(self, shares: Shares) -> bool:
        """Return whether a direction agrees less than the log's spread explains, and than half as usual."""
        usual = self.usual.agreement
        least = max(usual - _SPREADS * self._agreement_spread, _LEAST_AGREEMENT * usual)
        return shares.agreement < min(least, 0.5 * self.usual.agreement)

    def agrees_little(self, shares: Shares) -> bool:
        """Return whether a direction agrees less than most scans' do, so that a search is worth it."""
        usual = self.usual.agreement
        least = max(usual - _FEW_SPREADS * self._agreement_spread, _SEARCHED_AGREEMENT * usual)
        return self.is_known and shares.agreement < min(least, _LITTLE * usual)

    def is_weak(self, shares: Shares) -> bool:
        """Return whether a pose agrees so little that it may be off by part of a voxel in a direction.

        What contradicts more than usual counts, too. Until some scans have shown what is usual, a perfect
        fit is.
        """
        usual = self.usual.agreement if len(self._recent) >= _FEWEST else 1.0
        excess = max(shares.contradicting - self.usual.contradicting, 0.0)
        return shares.agreement - _CONTRADICTION_WEIGHT * excess < _LITTLE * usual

    def contradicts(self, shares: Shares, *, of_wide_search: bool = False) -> bool:
        """Return whether too much stands where rays passed: at all, or for the little that agrees.

        A pose that only a wide search found has to agree more.
        """
        usual = self.usual
        least_score = (_LEAST_WIDE_SCORE if of_wide_search else _LEAST_SCORE) * usual.score
        if shares.contradicting <= _TIMES_CONTRADICTING * usual.contradicting:
            return False
        return shares.contradicting > _MAX_CONTRADICTING or (usual.score > 0.0 and shares.score < least_score)

    def excludes(self, shares: Shares) -> bool:
        """Return whether it is another place: much stands where rays passed, a direction hardly agrees."""
        return (
            shares.contradicting > _OTHER_PLACE + _TIMES_CONTRADICTING * self.usual.contradicting
            or shares.agreement < _HARDLY * self.usual.agreement
        )
