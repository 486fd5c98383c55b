"""A log's frames in time, as warnings describe them."""

from dataclasses import dataclass

import numpy as np

from mapper.core.timebase import NS_PER_S, Stamps
from mapper.run.doubtful_frames import MAX_GAP_NS
from mapper.run.frame_records import stamps_of
from mapper.run.manifest import Manifest
from mapper.run.results import RunResults

MAX_SHARE = 0.05
"""Share of a log's frames that may be without a sure pose: good logs have up to that, paths that were wrong
had 8 % and more."""


@dataclass(frozen=True, slots=True)
class TimeLine:
    """Stamps of a log's frames.

    Attributes:
        stamps_ns: (N,) of all frames, in time order.
        usual_ns: Median interval.
        begins_ns: First stamps of sessions that were appended: what lies before them is a pause, no gap.
    """

    stamps_ns: Stamps
    usual_ns: float
    begins_ns: tuple[int, ...]

    @classmethod
    def of(cls, results: RunResults, manifest: Manifest) -> "TimeLine":
        """Return the stamps of a run's frames."""
        stamps_ns = stamps_of(results.records)
        usual_ns = float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
        return cls(stamps_ns, usual_ns, tuple(log.begins_ns for log in manifest.input.appended))

    def span(self, stamp_i_ns: int, stamp_j_ns: int) -> tuple[int, int]:
        """Return the indices of the frames of two stamps, in time order."""
        first, last = sorted(np.searchsorted(self.stamps_ns, [stamp_i_ns, stamp_j_ns]).tolist())
        return first, last

    def place(self, first: int, last: int) -> str:
        """Return between which seconds of the log two frames lie."""
        begin_s, end_s = (self.stamps_ns[[first, last]] - self.stamps_ns[0]) / NS_PER_S
        return span_text(begin_s, end_s)

    def is_at_an_end(self, first: int, last: int) -> bool:
        """Return whether few frames, of 2 s at most, lie before the later of two or after the first."""
        stamps_ns = self.stamps_ns
        sides = [(last, stamps_ns[last] - stamps_ns[0])]
        sides += [(len(stamps_ns) - 1 - first, stamps_ns[-1] - stamps_ns[first])]
        return any(
            frames <= MAX_SHARE * len(stamps_ns) and span_ns <= MAX_GAP_NS for frames, span_ns in sides
        )

    def duration_s(self, first: int, last: int) -> float:
        """Return the seconds between two frames."""
        return float(self.stamps_ns[last] - self.stamps_ns[first]) / NS_PER_S


def span_text(begin_s: float, end_s: float) -> str:
    """Return a span of time to a tenth of a second: one number if both ends round to it."""
    begin, end = f"{begin_s:.1f}", f"{end_s:.1f}"
    return f"{begin} s" if begin == end else f"{begin} … {end} s"


def counted(number: int, what: str) -> str:
    """Return a number and what it counts, in the plural if need be."""
    return f"{number} {what}{'s' if number > 1 else ''}"
