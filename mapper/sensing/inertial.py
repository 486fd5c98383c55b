"""Inertial readings of the body: angular velocities and accelerations at the same times."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S, Stamps

_LEAST_RATE_DENSITY, _LEAST_ACCELERATION_DENSITY = 5e-4, 1e-3
"""rad/s/√Hz and m/s²/√Hz: better ones are those of larger units than robots carry."""
_NORMAL_MAD = 1.4826
"""Standard deviation of a normal error, in medians of its absolute value."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialReadings:
    """Angular velocities and accelerations of the body, in its axes and the frames' clock.

    Attributes:
        stamps_ns: (N,) increasing times.
        rates_radps: (N, 3).
        accelerations_mps2: (N, 3) specific force: it points up at rest.
        gap_ns: Time between two readings beyond which the motion between them is unknown.
    """

    stamps_ns: Stamps
    rates_radps: Array
    accelerations_mps2: Array
    gap_ns: int

    @property
    def rate_density(self) -> float:
        """Noise of the angular velocities, rad/s/√Hz."""
        return max(self._density(self.rates_radps), _LEAST_RATE_DENSITY)

    @property
    def acceleration_density(self) -> float:
        """Noise of the accelerations, m/s²/√Hz."""
        return max(self._density(self.accelerations_mps2), _LEAST_ACCELERATION_DENSITY)

    def covers(self, begin_ns: int, end_ns: int) -> bool:
        """Return whether readings cover the time between two times, without a gap."""
        first = int(np.searchsorted(self.stamps_ns, begin_ns, side="right")) - 1
        last = int(np.searchsorted(self.stamps_ns, end_ns))
        if first < 0 or last >= len(self.stamps_ns):
            return False
        return bool((np.diff(self.stamps_ns[first : last + 1]) <= self.gap_ns).all())

    def between(self, begin_ns: int, end_ns: int) -> tuple[Array, Array, Array]:
        """Return (M, 3) mean angular velocities and accelerations of the pieces between, and (M,) seconds."""
        first = int(np.searchsorted(self.stamps_ns, begin_ns, side="right"))
        last = int(np.searchsorted(self.stamps_ns, end_ns))
        inner = self.stamps_ns[first:last]
        knots_ns = np.concatenate([[begin_ns], inner, [end_ns]])
        means = []
        for values in (self.rates_radps, self.accelerations_mps2):
            ends = [self._at(values, begin_ns), self._at(values, end_ns)]
            at = np.vstack([ends[0], values[first:last], ends[1]])
            means.append(0.5 * (at[1:] + at[:-1]))
        return means[0], means[1], np.diff(knots_ns) / NS_PER_S

    def _at(self, values: Array, stamp_ns: int) -> Array:
        after = min(max(int(np.searchsorted(self.stamps_ns, stamp_ns)), 1), len(values) - 1)
        begin_ns, end_ns = self.stamps_ns[after - 1 : after + 1].tolist()
        share = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        interpolated: Array = (1.0 - share) * values[after - 1] + share * values[after]
        return interpolated

    def _density(self, values: Array) -> float:
        """Return the noise of readings by their second differences, which motion hardly changes."""
        seconds = float(np.median(np.diff(self.stamps_ns))) / NS_PER_S
        sigma = _NORMAL_MAD * float(np.median(np.abs(np.diff(values, n=2, axis=0)))) / np.sqrt(6.0)
        return float(sigma * np.sqrt(seconds))
