"""Time of an RGB-D log's depth, as outlines in it and edges in its images show."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mapper.core.errors import FrameError
from mapper.core.frames import RgbdFrame
from mapper.core.geometry import Array, spread_indices
from mapper.core.timebase import NS_PER_S
from mapper.runtime.ordered_map import ordered_map
from mapper.sources.base import FrameRef, Log
from mapper.sources.config import SourceConfig
from mapper.sources.depth_outlines import Pixels, outlines
from mapper.sources.time_offsets import FEWEST_ESTIMATES, TimeOffset, peak_of, time_offset

_MOST_S, _MOST_FUSED_S = 0.3, 0.1
"""Largest offsets that are looked for, on request and in each build: more makes a build doubtful."""
_BURSTS, _BURST_FRAMES = 8, 8
"""Most parts of a log in which depth's time is compared, and most frames of each whose depth is."""
_LEAST_RISE = 0.2
"""Score at the best time above that of the farthest; of a camera at rest all times are alike."""


def depth_time_offset(log: Log, config: SourceConfig, *, most_s: float = _MOST_S) -> TimeOffset:
    """Return how late the stamps of an RGB-D log's depth are, from its images alone.

    Args:
        log: The log.
        config: The offset that is applied already.
        most_s: Largest offset that is tried.
    """
    late_s = -_offsets_s(log, most_s=most_s)
    set_s = config.depth_offset_s or 0.0
    return time_offset("depth", late_s, setting="source.depth_offset_s", set_s=set_s)


def with_depth_on_time(log: Log, config: SourceConfig) -> tuple[Log, str]:
    """Return a log whose depth has the time that its images show, and a sentence where that is another.

    Images stay in pairs as they are. An offset that the user has set is not changed.
    """
    if log.sensor != "rgbd" or config.depth_offset_s is not None:
        return log, ""
    offset = depth_time_offset(log, config, most_s=_MOST_FUSED_S)
    if not offset.remedy or offset.late_s is None:
        return log, ""
    late_ns = round(offset.late_s * NS_PER_S)

    def entry_at(index: int) -> FrameRef:
        entry = log.entry_at(index)
        return replace(entry, depth_delay_ns=entry.depth_delay_ns - late_ns)

    return (
        replace(log, entry_at=entry_at),
        f"depth: {offset.found}: it is fused at its true time, but paired by its stamps; {offset.remedy}",
    )


class _Timed(NamedTuple):
    """Frame's outlines as of ``outlines``, with the times of its images, nanoseconds."""

    image_ns: int
    depth_ns: int
    gradient: Pixels
    edges: Pixels


def _offsets_s(log: Log, *, most_s: float) -> Array:
    """Return how much later depth shows the scene than its stamps say: (M,) seconds, of parts of a log.

    The gradient of brightness at outlines in depth is averaged for every time between the two images, and is
    largest at the true one, between frames by a parabola. Parts without outlines or motion have no estimate.

    Args:
        log: An RGB-D log.
        most_s: Largest offset that is tried.
    """
    period_s = float(np.median(np.diff(log.stamps_ns))) / NS_PER_S if len(log) > 1 else np.inf
    reach = int(most_s / period_s)
    compared = len(log) - 2 * reach
    length = min(_BURST_FRAMES, compared // FEWEST_ESTIMATES)  # no frame's depth in two parts
    if log.sensor != "rgbd" or reach == 0 or length < 1:
        return np.empty(0)
    found = []
    for first in spread_indices(compared - length + 1, min(_BURSTS, compared // length)).tolist():
        entries = [log.entry_at(first + k) for k in range(length + 2 * reach)]
        offset_s = _burst_offset_s(list(ordered_map(_timed_outlines, entries)), reach)
        if offset_s is not None:
            found.append(offset_s)
    return np.array(found)


def _timed_outlines(entry: FrameRef) -> _Timed | None:
    try:
        frame = entry.load(colour=False)
    except FrameError:
        return None
    both = outlines(frame) if isinstance(frame, RgbdFrame) else None
    if both is None:
        return None
    return _Timed(entry.stamp_ns, entry.depth_stamp_ns, *both)


def _burst_offset_s(frames: Sequence[_Timed | None], reach: int) -> float | None:
    """Return the best offset of depth to images up to ``reach`` frames before and after; None if unclear."""
    scores, offsets_s = [], []
    for centre in range(reach, len(frames) - reach):
        around = [frame for frame in frames[centre - reach : centre + reach + 1] if frame is not None]
        depth = frames[centre]
        if depth is not None and len(around) == 2 * reach + 1:
            on_outlines = depth.edges > 0.0
            scores.append([frame.gradient[on_outlines].mean() for frame in around])
            offsets_s.append([(frame.image_ns - depth.depth_ns) / NS_PER_S for frame in around])
    if not scores:
        return None
    mean, at_s = np.mean(scores, axis=0), np.mean(offsets_s, axis=0)
    return peak_of(at_s, mean) if mean.max() - max(mean[0], mean[-1]) >= _LEAST_RISE else None
