"""Gyroscope: angular velocities of a log, and the rotation between two times that they integrate to."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.core.timebase import GAP_INTERVALS, NS_PER_S, Stamps

_LEAST_GAP_NS = 50_000_000
"""Readings farther apart than this, and than ``GAP_INTERVALS`` of their usual ones, have a gap between: those
of 20 Hz show the motion of a hand, and so do others of which some are lost."""
_BURST = 20
"""Readings over which the usual interval is measured: drivers stamp some of them at once."""
_FROZEN_NS, _FROZEN_READINGS = NS_PER_S // 5, 10
"""Time, and number of readings, for which no unit that works repeats the very same one: its noise differs."""
_SATURATED_READINGS, _LEAST_SATURATED = 5, 1.0
"""Readings that have exactly the largest number of the log are at the end of their range; angular velocities
beyond 1 rad/s."""


def range_end(readings: Array, *, beyond: float) -> tuple[float, NDArray[np.bool_]] | None:
    """Return the end of a unit's range and which of (N, 3) readings are there, on any axis.

    None where too few readings are the largest, or where that is not beyond a number.
    """
    largest = np.abs(readings).max(axis=1, initial=0.0)
    limit = float(largest.max(initial=0.0))
    at_end = largest == limit
    return (limit, at_end) if at_end.sum() >= _SATURATED_READINGS and limit > beyond else None


@dataclass(frozen=True, slots=True, eq=False)
class Gyroscope:
    """Angular velocities of an inertial measurement unit.

    Attributes:
        name: Topic or file.
        stamps_ns: (N,) int64 nanoseconds, strictly increasing.
        rates_radps: (N, 3) float64, in the unit's own axes; rad/s as far as the log says.
        R_body_imu: (3, 3) its mounting, if the log states it.
        is_of_body: Whether they have been calibrated: rad/s of the body, in its axes and the frames' clock.
        interval_ns: Usual time between two readings; 0 of fewer than two.
    """

    name: str
    stamps_ns: Stamps
    rates_radps: Array
    R_body_imu: Array | None = None
    is_of_body: bool = False
    interval_ns: int = field(init=False)

    def __post_init__(self) -> None:
        count = min(_BURST, len(self) - 1)
        usual_ns = (
            int(np.median(self.stamps_ns[count:] - self.stamps_ns[:-count])) // count if count > 0 else 0
        )
        object.__setattr__(self, "interval_ns", usual_ns)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def gap_ns(self) -> int:
        """Time between two readings beyond which the rotation between them is unknown."""
        return max(round(GAP_INTERVALS * self.interval_ns), _LEAST_GAP_NS)

    def without_faults(self) -> tuple["Gyroscope | None", list[str]]:
        """Return the readings of a unit that works, None if there are none, and notes on others and on gaps.

        It turned faster than a reading at the end of its range says, and a frozen one says nothing; what is
        left has a gap there.
        """
        notes = []
        kept = self
        if (frozen := self._are_frozen()).any():
            notes.append(
                f"{self.name}: {frozen.sum()} of {len(self)} angular velocities repeat those before, for "
                f"{_FROZEN_NS / NS_PER_S:g} s and longer; was the unit frozen? Left out"
            )
            kept = self._of(~frozen)
        if (found := range_end(kept.rates_radps, beyond=_LEAST_SATURATED)) is not None:
            limit, saturated = found
            notes.append(
                f"{self.name}: {saturated.sum()} of {len(kept)} angular velocities are at the end of the "
                f"gyroscope's range, {limit:g}; left out"
            )
            kept = kept._of(~saturated)
        if len(kept) < 2:
            return None, [*notes, f"{self.name}: no angular velocities"]
        intervals_ns = np.diff(kept.stamps_ns)
        gaps = intervals_ns[intervals_ns > kept.gap_ns]
        if len(gaps):
            notes.append(
                f"{self.name}: {len(gaps)} gaps in the angular velocities, the longest of "
                f"{gaps.max() / NS_PER_S:.2f} s"
            )
        return kept, notes

    def rotations(
        self, begins_ns: Stamps, ends_ns: Stamps, bias: Array, scale: float = 1.0
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the rotations R_begin_end of the unit between pairs of times, and which are known.

        The angular velocity is linear between readings; each of its pieces turns by the exponential of the
        Magnus expansion's first two terms (Iserles & Nørsett 1999): its mean, and the coning.

        Args:
            begins_ns: (M,) times.
            ends_ns: (M,) times not before these.
            bias: (3,) that is subtracted from the readings after these are multiplied, rad/s.
            scale: Factor on the readings.

        Returns:
            (M, 3, 3), and (M,) false where readings do not cover the time or have a gap.
        """
        from mapper.sensing.gyroscope_kernels import integrate  # numba takes long to import

        R_begin_end, known = integrate(
            self.stamps_ns, self.rates_radps, begins_ns, ends_ns, bias, scale, self.gap_ns
        )
        return R_begin_end, known

    def rates_at(self, stamps_ns: Stamps) -> Array:
        """Return the (M, 3) readings at (M,) times, on the lines between them."""
        columns = [np.interp(stamps_ns, self.stamps_ns, column) for column in self.rates_radps.T]
        return np.stack(columns, axis=1)

    def turned_rad(self) -> Array:
        """Return (N,) the angle turned until each reading, about whatever axes."""
        speeds_radps = np.linalg.norm(self.rates_radps, axis=1)
        steps_s = np.diff(self.stamps_ns) / NS_PER_S
        return np.concatenate([[0.0], np.cumsum(0.5 * steps_s * (speeds_radps[1:] + speeds_radps[:-1]))])

    def _are_frozen(self) -> NDArray[np.bool_]:
        """Return which (N,) readings repeat the one before, in runs that no noise leaves."""
        repeats = np.zeros(len(self), np.bool_)
        repeats[1:] = (self.rates_radps[1:] == self.rates_radps[:-1]).all(axis=1)
        run = np.cumsum(~repeats)
        fewest = max(_FROZEN_READINGS, _FROZEN_NS // max(self.interval_ns, 1))
        return np.asarray(repeats & (np.bincount(run)[run] > fewest))

    def _of(self, kept: NDArray[np.bool_]) -> "Gyroscope":
        return replace(self, stamps_ns=self.stamps_ns[kept], rates_radps=self.rates_radps[kept])
