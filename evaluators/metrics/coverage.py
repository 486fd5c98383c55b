"""Coverage: the share of a log that has poses, without which errors favour a method that gives up early."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.timebase import GAP_INTERVALS, MAX_TRUTH_GAP_NS, NS_PER_S, Stamps, nearest, stretches
from mapper.evaluators.metrics.metric import Metric


def frame_coverage(frames_ns: Stamps, poses_ns: Stamps) -> list[Metric]:
    """Return which share of a log's frames has a pose, and the gaps: frames without, and pauses of the log.

    A pose belongs to the frame that it is nearest to, within half the usual interval of frames and 20 ms.

    Args:
        frames_ns: (N ≥ 1,) every frame of the log, also those that could not be read.
        poses_ns: (M ≥ 1,) the trajectory's.
    """
    usual_ns = np.median(np.diff(frames_ns)) if len(frames_ns) > 1 else np.inf
    _, apart_ns = nearest(poses_ns, frames_ns)
    tracked = apart_ns <= min(MAX_TRUTH_GAP_NS, 0.5 * usual_ns)
    return [
        Metric("coverage", 100.0 * float(tracked.mean()), "%", "frames with a pose"),
        Metric("frames without a pose", int((~tracked).sum()), "frames"),
        *_gap_metrics(np.concatenate([_untracked_s(frames_ns, tracked), _pauses_s(frames_ns, tracked)])),
    ]


def time_coverage(poses_ns: Stamps, *, begin_ns: int, end_ns: int) -> list[Metric]:
    """Return which share of a time has poses no further apart than usual, and the pauses between others.

    Args:
        poses_ns: (N ≥ 1,) the trajectory's.
        begin_ns: Begin of the time that the truth covers.
        end_ns: Its end, later than that.
    """
    usual_ns = float(np.median(np.diff(poses_ns))) if len(poses_ns) > 1 else 0.0
    inside = poses_ns[(poses_ns >= begin_ns) & (poses_ns <= end_ns)]
    pauses_ns = np.diff(np.concatenate([[begin_ns], inside, [end_ns]])).astype(np.float64)
    gaps_s = pauses_ns[pauses_ns > GAP_INTERVALS * usual_ns] / NS_PER_S
    covered = 1.0 - float(gaps_s.sum()) * NS_PER_S / (end_ns - begin_ns)
    return [Metric("coverage", 100.0 * covered, "%", "share of the truth's time"), *_gap_metrics(gaps_s)]


def _gap_metrics(gaps_s: NDArray[np.float64]) -> list[Metric]:
    return [
        Metric("gaps", len(gaps_s), "gaps"),
        Metric("longest gap", float(gaps_s.max(initial=0.0)), "s"),
    ]


def _pauses_s(frames_ns: Stamps, tracked: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the pauses between frames with poses that are longer than usual."""
    pauses_ns = np.diff(frames_ns).astype(np.float64)
    usual_ns = float(np.median(pauses_ns)) if len(pauses_ns) else 0.0
    between = tracked[:-1] & tracked[1:]
    return pauses_ns[between & (pauses_ns > GAP_INTERVALS * usual_ns)] / NS_PER_S


def _untracked_s(frames_ns: Stamps, tracked: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return how long each run of frames without a pose lasts, from the pose before it to the one after."""
    ends = np.array(stretches(~tracked, margin=1), np.intp).reshape(-1, 2)
    return np.diff(frames_ns[ends], axis=1)[:, 0] / NS_PER_S
