"""Checks of a log's frames while they are read: images and scans that repeat, and far returns."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Literal

from mapper.core.doubts import Doubt
from mapper.core.frames import Frame, Scan
from mapper.core.timebase import NS_PER_S
from mapper.sources.base import FrameRef, Log
from mapper.sources.point_times import MAX_SWEEP_S
from mapper.sources.valid_returns import FARTHEST_M

FROZEN_IMAGES = 5
"""Number of frames with the very same pixels that is noted: a camera's noise makes even two of them differ,
and drivers repeat a frame or two when a sensor is late."""
FROZEN_SCANS = 3
"""As ``FROZEN_IMAGES``, of scans, of whose thousands of ranges even two never agree, or over a second."""

_MOST_REPEATS = 0.2
"""Share of the frames that repeat the one before: drivers repeat fewer."""

_Repeating = Literal["image", "depth", "scan"]
_FROZEN: tuple[tuple[_Repeating, str, str, int], ...] = (
    ("image", "show the same image; was the camera frozen?", "same image", FROZEN_IMAGES),
    ("depth", "have the same depth image; was the depth camera frozen?", "same depth image", FROZEN_IMAGES),
    ("scan", "have the same points; was the LiDAR or its driver frozen?", "same points", FROZEN_SCANS),
)
"""Data that may repeat, what is said of a run and of one frame of it, and its least length."""


@dataclass(frozen=True, slots=True)
class _Reading:
    """Checksums of a frame's images or of its points, what was left out, and whether points have times."""

    image: int | None = None
    depth: int | None = None
    scan: int | None = None
    far_returns: int = 0
    untimed_returns: int = 0
    is_timed: bool | None = None


class ReadingChecks:
    """Checks of the frames that are loaded, in any thread and any order.

    Attributes:
        log: The log to be read: the same frames, each of which is checked when it is loaded.
    """

    def __init__(self, log: Log) -> None:
        self._stamps_ns = log.stamps_ns
        self._readings: dict[int, _Reading] = {}

        def entry_at(index: int) -> FrameRef:
            entry = log.entry_at(index)

            def read(colour: bool) -> Frame:
                frame = entry.read(colour)
                self.add(index, frame)
                return frame

            return replace(entry, read=read, returns=entry.scan)

        self.log = replace(log, entry_at=entry_at)

    def add(self, index: int, frame: Frame) -> None:
        """Take in frame ``index`` of the log; what was loaded first counts, be it in colour or in grey."""
        if index not in self._readings:
            self._readings[index] = _reading_of(frame)

    def reading(self, index: int) -> Any:
        """Return what is known of a frame, for ``restore``; None if it was not loaded."""
        return self._readings.get(index)

    def restore(self, index: int, reading: Any) -> None:
        """Take over what is known of a frame that is not read again."""
        if reading is not None:
            self._readings[index] = reading

    def repeated(self, what: _Repeating, *, fewest: int) -> list[range]:
        """Return the runs of a number of frames or more, or of a second and more, with the same data.

        A frame that was not loaded, or could not be, counts as those around it.
        """
        loaded = sorted(
            index for index, reading in self._readings.items() if getattr(reading, what) is not None
        )
        same = [
            list(run) for _, run in groupby(loaded, key=lambda index: getattr(self._readings[index], what))
        ]

        runs = [range(run[0], run[-1] + 1) for run in same]
        return [run for run in runs if len(run) >= fewest or self._lasts(run)]

    def _lasts(self, run: range) -> bool:
        lasted_ns = int(self._stamps_ns[run[-1]] - self._stamps_ns[run[0]])
        return len(run) >= FROZEN_SCANS and lasted_ns >= NS_PER_S

    def notes(self) -> list[tuple[str, str]]:
        """Return what is suspicious about the frames loaded so far: kind and sentence of each warning."""
        found = (
            ("frozen", self._frozen()),
            ("log", self._slow_sensors()),
            ("far returns", self._far_returns()),
            ("log", self._untimed_returns()),
            ("log", self._untimed_scans()),
        )
        return [(kind, sentence) for kind, sentences in found for sentence in sentences]

    def _frozen(self) -> Iterator[str]:
        """Yield where a sensor seems to have been frozen, a sentence each."""
        for what, said, _, fewest in _FROZEN:
            yield from (f"{self._named(run)} {said}" for run in self.repeated(what, fewest=fewest))

    def _slow_sensors(self) -> Iterator[str]:
        """Yield a sentence about a sensor that is slower than its stamps, if many frames repeat the last."""
        for what, _, named, fewest in _FROZEN:
            runs = self.repeated(what, fewest=2) if what != "depth" else []  # which may be slower than colour
            again = sum(len(run) - 1 for run in runs if len(run) < fewest and not self._lasts(run))
            if again > max(_MOST_REPEATS * len(self._readings), FROZEN_IMAGES):
                yield (
                    f"{again} of {len(self._readings)} frames have the {named} as the one before at another "
                    "stamp: the sensor is slower than its stamps; was the log converted to a higher rate?"
                )

    def doubts(self) -> dict[int, list[Doubt]]:
        """Return why frames are doubtful, by stamp: they repeat the data of an earlier one."""
        doubts: dict[int, list[Doubt]] = {}
        for what, _, named, fewest in _FROZEN:
            for run in self.repeated(what, fewest=fewest):
                for index in run[1:]:
                    doubt = Doubt("repeated image", f"{named} as {index - run[0]} frames before")
                    doubts.setdefault(int(self._stamps_ns[index]), []).append(doubt)
        return doubts

    def _named(self, run: range) -> str:
        begin_s, end_s = ((self._stamps_ns[[run[0], run[-1]]] - self._stamps_ns[0]) / NS_PER_S).tolist()
        return f"frames {run[0]} … {run[-1]}, {begin_s:.1f} … {end_s:.1f} s after the first,"

    def _far_returns(self) -> Iterator[str]:
        """Yield a sentence about the returns that were left out, if there were any."""
        counts = [reading.far_returns for reading in self._readings.values() if reading.far_returns]
        if counts:
            yield (
                f"{sum(counts)} returns in {len(counts)} of {len(self._readings)} scans are farther than "
                f"{FARTHEST_M:g} m, which no sensor reaches; left out"
            )

    def _untimed_returns(self) -> Iterator[str]:
        """Yield a sentence about the returns whose time cannot be right, if there were any."""
        counts = [reading.untimed_returns for reading in self._readings.values() if reading.untimed_returns]
        if counts:
            yield (
                f"{sum(counts)} returns in {len(counts)} of {len(self._readings)} scans have no times (0, "
                f"NaN, or more than {MAX_SWEEP_S:g} s from the others'); left out"
            )

    def _untimed_scans(self) -> Iterator[str]:
        """Yield a sentence about the scans without times among others that have them."""
        are_timed = [reading.is_timed for reading in self._readings.values() if reading.is_timed is not None]
        if any(are_timed) and not all(are_timed):
            yield (
                f"{are_timed.count(False)} of {len(are_timed)} scans have no times of their points and are "
                "not deskewed, unlike the others"
            )


def _reading_of(frame: Frame) -> _Reading:
    if isinstance(frame, Scan):
        return _Reading(
            scan=frame.checksum,
            far_returns=frame.far_returns,
            untimed_returns=frame.untimed_returns,
            is_timed=frame.times_s is not None if len(frame.points_body) else None,
        )
    return _Reading(image=frame.image_checksum, depth=frame.depth_checksum)
