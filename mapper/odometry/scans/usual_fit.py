"""Fit that scans of this log usually have, and what speaks against a pose that fits less."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Transform, angle_between, inverse
from mapper.odometry.scans.motion_model import Spread

_RECENT = 30  # recent scans whose fits are usual
_SPREADS = 4.0  # so many standard deviations below its median a share is unusual
_FEW_SPREADS, _LITTLE = 2.0, 0.75  # and so many, of this part of it, make a search worth its time
_NORMAL = 1.4826  # standard deviations in a median absolute deviation
_FEWEST = 5
_LEAST_OVERLAP_SPREAD = 0.04
_LEAST_AGREEMENT_SPREAD = 0.06
_MAX_CONTRADICTING, _TIMES_CONTRADICTING = 0.012, 4.0
"""Share of points in space that rays passed, none of them by a grazing ray: right poses have up to 0.007,
wrong ones 0.013 to 0.03 and more. It may be so many times the usual one where people or traffic move."""
_OTHER_PLACE, _HARDLY = 0.1, 0.2
_JUMP_SPREADS = 8.0
_LEAST_JUMP_M, _LEAST_JUMP_RAD = 0.15, 0.09


@dataclass(frozen=True, slots=True)
class Shares:
    """Shares of one scan's points under a pose.

    Attributes:
        overlap: With a partner on the keyframe.
        agreement: On its surfaces, in the direction where the least agree.
        contradicting: In space that rays passed.
    """

    overlap: float
    agreement: float
    contradicting: float


@dataclass(frozen=True, slots=True)
class Jump:
    """Deviation from the predicted pose, and how much would be a surprise."""

    translation_m: float
    rotation_rad: float
    limit_m: float
    limit_rad: float

    @property
    def is_unusual(self) -> bool:
        """Whether it is a surprise."""
        return self.translation_m > self.limit_m or self.rotation_rad > self.limit_rad

    @property
    def text(self) -> str:
        """Both in words."""
        return (
            f"jump of {self.translation_m:.2f} m and {np.degrees(self.rotation_rad):.0f}° from the predicted "
            f"pose, where {self.limit_m:.2f} m and {np.degrees(self.limit_rad):.0f}° would be much"
        )


def jump_between(T_world_predicted: Transform, T_world_found: Transform, spread: Spread | None) -> Jump:
    """Return how far a pose lies from the predicted one; without a known spread nothing is a surprise."""
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

    def clear(self) -> None:
        """Forget all."""
        self._recent.clear()
        self.usual = Shares(overlap=1.0, agreement=1.0, contradicting=0.0)
        self._overlap_spread, self._agreement_spread = _LEAST_OVERLAP_SPREAD, _LEAST_AGREEMENT_SPREAD

    @property
    def is_known(self) -> bool:
        """Whether any scan told what is usual; until then poses are searched for, but none is doubted."""
        return bool(self._recent)

    def has_little_overlap(self, shares: Shares, *, usual_ratio: float) -> bool:
        """Return whether the overlap is below the log's spread, and this share of the usual one."""
        least = self.usual.overlap - _SPREADS * self._overlap_spread
        return shares.overlap < min(least, usual_ratio * self.usual.overlap)

    def disagrees(self, shares: Shares) -> bool:
        """Return whether a direction agrees less than the log's spread explains, and than half as usual."""
        least = self.usual.agreement - _SPREADS * self._agreement_spread
        return shares.agreement < min(least, 0.5 * self.usual.agreement)

    def agrees_little(self, shares: Shares) -> bool:
        """Return whether a direction agrees less than most scans' do, so that a search is worth it."""
        least = self.usual.agreement - _FEW_SPREADS * self._agreement_spread
        return self.is_known and shares.agreement < min(least, _LITTLE * self.usual.agreement)

    def contradicts(self, shares: Shares) -> bool:
        """Return whether too much stands where rays passed."""
        return shares.contradicting > max(_MAX_CONTRADICTING, _TIMES_CONTRADICTING * self.usual.contradicting)

    def excludes(self, shares: Shares) -> bool:
        """Return whether it is another place: much stands where rays passed, a direction hardly agrees."""
        return (
            shares.contradicting > _OTHER_PLACE + _TIMES_CONTRADICTING * self.usual.contradicting
            or shares.agreement < _HARDLY * self.usual.agreement
        )
