"""Time offsets of a log's sensors against its frames: as they are estimated, and as settings correct them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.core.running_median import SIGMAS_PER_MAD
from mapper.core.timebase import NS_PER_S, Stamps, seconds_text_from_ns
from mapper.sources.base import Log, Readings, later
from mapper.sources.config import SourceConfig

FEWEST_ESTIMATES, _MOST_SIGMA_S = 3, 0.02
"""Estimates of parts of a log: fewer, or a median less sure, do not tell an offset."""
_RESOLUTION_S, _SURE_SIGMAS = 0.002, 3.0
"""Error that estimates share (shutters, delays of filters), and standard deviations that are no chance."""
_UNITS_NS = {"µs": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
"""Units in which files have stamps that should be nanoseconds."""
_LONGEST_NS = 10**15
"""Eleven days: stamps from 0 on, taken in another unit, last for decades."""
_SETTINGS = {
    "truth": "truth_offset_s",
    "wheels": "wheels_offset_s",
    **dict.fromkeys(("gyroscope", "accelerations"), "imu_offset_s"),
}


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """Time offset of one of a log's sensors.

    Attributes:
        sensor: "depth", "gyroscope", "wheels", "truth" or "device poses", or the name of a sensor beside.
        late_s: How much later its stamps are than those of frames of the same moment; None if that cannot be
            told.
        sigma_s: Standard deviation of it.
        remedy: What corrects it, as an option or in words; empty where nothing need.
        is_measured: Whether it was looked for.
    """

    sensor: str
    late_s: float | None
    sigma_s: float | None
    remedy: str = ""
    is_measured: bool = True

    @property
    def found(self) -> str:
        """The offset in words, without the remedy."""
        if not self.is_measured:
            return "not measured; a build doubts LiDARs and depth cameras that lie beside the tracked one"
        if self.late_s is None or self.sigma_s is None:
            return "cannot be told: too little motion, too few frames, or no agreement"
        side = "late" if self.late_s >= 0.0 else "early"
        return f"stamps are {1e3 * abs(self.late_s):.0f} ± {1e3 * self.sigma_s:.0f} ms {side}"

    @property
    def text(self) -> str:
        """The offset in words, and the remedy."""
        return f"{self.found}; {self.remedy}" if self.remedy else self.found


def time_offset(
    sensor: str, estimates_s: Sequence[float] | Array, *, setting: str, set_s: float
) -> TimeOffset:
    """Return a sensor's time offset, from estimates of parts of a log.

    Args:
        sensor: Name of the sensor.
        estimates_s: How much later its stamps are, seconds.
        setting: Setting that is added to its stamps; empty if there is none.
        set_s: What that is now.
    """
    if len(estimates_s) < FEWEST_ESTIMATES:
        return TimeOffset(sensor, None, None)
    late_s = float(np.median(estimates_s))
    deviation_s = SIGMAS_PER_MAD * float(np.median(np.abs(np.asarray(estimates_s) - late_s)))
    sigma_s = sqrt(deviation_s**2 / len(estimates_s) + _RESOLUTION_S**2)
    if sigma_s > _MOST_SIGMA_S:
        return TimeOffset(sensor, None, None)
    is_sure = abs(late_s) > _SURE_SIGMAS * sigma_s
    remedy = (
        f"--set {setting}={round(set_s - late_s, 3) + 0.0:g} corrects that" if is_sure and setting else ""
    )
    return TimeOffset(sensor, late_s, sigma_s, remedy)


def peak_of(at_s: NDArray[np.floating], score: NDArray[np.floating]) -> float:
    """Return the time of the largest of (N,) scores, on a parabola through it and its neighbours."""
    k = int(np.argmax(score))
    if not 0 < k < len(score) - 1:
        return float(at_s[k])
    before, most, after = score[k - 1 : k + 2].tolist()
    bend = before - 2.0 * most + after
    steps = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return float(at_s[k] + steps * 0.5 * (at_s[k + 1] - at_s[k - 1]))


def with_time_offsets(log: Log, config: SourceConfig) -> Log:
    """Return a log whose readings and poses have the settings' offsets added to their stamps.

    A truth of another time than the frames' is left out.
    """
    truth_ns, wheels_ns, imu_ns, images_ns = (
        round(offset_s * NS_PER_S)
        for offset_s in (
            config.truth_offset_s,
            config.wheels_offset_s,
            config.imu_offset_s,
            config.images_offset_s,
        )
    )
    truth, notes = log.truth, list[str]()
    if not config.require_truth:  # which refuses the log
        truth, notes = in_log_time(truth, log.stamps_ns, "truth", offset_s=config.truth_offset_s)
    return replace(
        log,
        notes=[*log.notes, *notes],
        truth=later(truth, truth_ns),
        wheels=later(log.wheels, wheels_ns),
        gyroscope=later(log.gyroscope, imu_ns),
        accelerations=later(log.accelerations, imu_ns),
        images=[replace(one, stamps_ns=one.stamps_ns + images_ns) for one in log.images],
    )


def in_log_time(
    readings: Readings | None, frames_ns: Stamps, name: str, *, offset_s: float = 0.0
) -> tuple[Readings | None, list[str]]:
    """Return readings with stamps of the frames' time, and a note on stamps in another unit, or of no use.

    Args:
        readings: As they were read.
        frames_ns: (N,) stamps of the frames, increasing.
        name: What they are: of ``wheels`` and the like a setting moves the stamps.
        offset_s: What that setting is.
    """
    if readings is None or not len(readings.stamps_ns):
        return readings, []
    frames_ns = frames_ns - round(offset_s * NS_PER_S)
    if _overlap(readings.stamps_ns, frames_ns):
        return readings, []
    for unit, unit_ns in _UNITS_NS.items():
        if readings.stamps_ns[-1] <= np.iinfo(np.int64).max // unit_ns:
            stamps_ns = readings.stamps_ns * unit_ns
            if np.ptp(stamps_ns) < _LONGEST_NS and _overlap(stamps_ns, frames_ns):
                note = f"{name}: stamps are taken in {unit}, as in ns none is of the frames' time"
                return replace(readings, stamps_ns=stamps_ns), [note]
    first_ns, frame_ns = int(readings.stamps_ns[0]), int(frames_ns[0])
    apart_s = offset_s + (frame_ns - first_ns) / NS_PER_S
    setting = _SETTINGS.get(name)
    remedy = f"; source.{setting}={apart_s:.3f} lets them begin with the frames" if setting else ""
    return None, [
        f"{name}: stamps begin at {seconds_text_from_ns(first_ns)} s and frames at "
        f"{seconds_text_from_ns(frame_ns)} s, so none is of their time; not used{remedy}"
    ]


def _overlap(readings_ns: Stamps, frames_ns: Stamps) -> bool:
    """Return whether readings are of the frames' time, or less than a second from it."""
    return bool(readings_ns[0] - NS_PER_S <= frames_ns[-1] and frames_ns[0] <= readings_ns[-1] + NS_PER_S)
