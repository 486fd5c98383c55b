"""The part of a log that is used: a range of frames, a stride, frames with truth only, no own vehicle.

Times of a LiDAR's points are as the user says they are: scaled, ignored, or by azimuth.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import SourceError
from mapper.core.frames import Frame, Scan
from mapper.core.timebase import NS_PER_S, nearest
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.merged_scans import with_whole_turns
from mapper.sources.point_times import azimuth_times_s
from mapper.sources.time_offsets import with_time_offsets
from mapper.sources.vehicle import without_vehicle


def selected(log: Log, config: SourceConfig) -> Log:
    """Return the frames ``first_frame`` … ``last_frame`` by ``stride``, with truth where it is required.

    Returns of the sensor's own vehicle are left out of them.

    Raises:
        SourceError: Nothing is left, or truth is required of a log that has none.
    """
    log = with_whole_turns(log)
    if log.sensor != "rgbd" and (config.point_time_scale != 1.0 or config.sweep_s is not None):
        log = with_point_times(log, time_scale=config.point_time_scale, sweep_s=config.sweep_s)
    log = with_time_offsets(log, config)
    if config.body.clears:
        log = without_vehicle(log, config.body)
    total = len(log)
    stop = total if config.last_frame is None else config.last_frame + 1
    is_used = np.zeros(total, dtype=bool)
    is_used[config.first_frame : stop : config.stride] = True
    if not is_used.any():
        last = "end" if config.last_frame is None else config.last_frame
        raise SourceError(
            f"{log.path}: no frame is left of the range {config.first_frame} … {last}; "
            f"the log has {total} frames, 0 … {total - 1}"
        )
    notes = list(log.notes)
    if config.require_truth:
        has_truth = _has_truth(log, max_gap_s=config.max_truth_gap_s)
        dropped = int((is_used & ~has_truth).sum())
        is_used &= has_truth
        within = f"within {config.max_truth_gap_s * 1e3:g} ms"
        if not is_used.any():
            raise SourceError(f"{log.path}: no selected frame has ground truth {within}")
        if dropped:
            notes.append(f"{dropped} frames have no ground truth {within}; left out")
    if is_used.all():
        return log
    used = np.flatnonzero(is_used)
    notes.append(f"{len(used)} of {total} frames selected")
    beside = [replace(one, log=one.log[:: config.stride]) for one in log.beside]
    return replace(log.subset(used), beside=beside, notes=notes)


def too_few_text(frames: int, least: int, notes: Iterable[str]) -> str:
    """Return that a log has too few frames for a map, with what was left out of it by its notes."""
    left_out = next((note for note in notes if "left out" in note or "frozen" in note), None)
    read = f"only {frames} {'frame was' if frames == 1 else 'frames were'} read"
    remedy = "record longer, or lower that limit" if left_out is None else left_out
    return f"{read}, want at least {least} (min_tracked_frames); {remedy}"


def _has_truth(log: Log, *, max_gap_s: float) -> NDArray[np.bool_]:
    if log.truth is None:
        raise SourceError(
            f"{log.path}: ground truth is required (source.require_truth), but the log has none"
        )
    _, gap_ns = nearest(log.truth.stamps_ns, log.stamps_ns)
    return gap_ns <= round(max_gap_s * NS_PER_S)


def with_point_times(log: Log, *, time_scale: float, sweep_s: float | None) -> Log:
    """Return a log whose scans have other times.

    Args:
        log: Log of a LiDAR.
        time_scale: Factor on the times of the points; 0 leaves them out.
        sweep_s: Duration of a turn of scans without times, which get some by azimuth; None leaves them.
    """

    def timed(frame: Frame) -> Frame:
        if not isinstance(frame, Scan):
            return frame
        if frame.times_s is not None:
            return replace(frame, times_s=_scaled(frame.times_s, time_scale))
        if sweep_s is None:
            return frame
        return replace(frame, times_s=azimuth_times_s(frame.points_body, frame.origin_body, sweep_s))

    return log.with_frames(timed)


def _scaled(times_s: NDArray[np.float32], scale: float) -> NDArray[np.float32] | None:
    """Return scaled times; None for a scale of 0.

    Of times that count backwards the largest is that of the stamp: of those until the end of the sweep, and
    of negative ones that ought to be positive.
    """
    if scale == 0.0 or len(times_s) == 0:
        return None
    from_s = times_s.max() if scale < 0.0 else np.float32(0.0)
    return np.float32(scale) * (times_s - from_s)
