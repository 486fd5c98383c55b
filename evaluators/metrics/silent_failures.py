"""Silent failures: stretches of a path that are wrong though no frame of them is doubtful or lost."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, adjoint, inverse, log
from mapper.core.timebase import MAX_TRUTH_GAP_NS, NS_PER_S, nearest
from mapper.core.trajectory import Trajectory
from mapper.run.frame_records import FrameRecord, stamps_of

WRONG_M, WRONG_RAD, WRONG_SIGMAS = 0.2, float(np.deg2rad(5.0)), 5.0
"""A relative pose is wrong if it is farther off than either, and than this many sigmas."""
RIGHT_M, RIGHT_RAD = 0.25 * WRONG_M, 0.25 * WRONG_RAD
"""A frame is right if it is no farther off than this, seen from the nearest frame that is not doubtful."""
_WINDOW_NS = NS_PER_S


@dataclass(frozen=True, slots=True)
class DoubtCheck:
    """Comparison of the frames that a run calls doubtful or lost with those that are wrong.

    Attributes:
        windows: Number of pairs of placed frames a window apart that the truth covers, one for each frame.
        wrong: Number of windows whose relative pose is wrong, flagged or not.
        silent: Number of wrong windows of which no frame is doubtful, lost or skipped.
        silent_at_s: Time of the first frame of each silent window, seconds after the log's first.
        worst_m: Largest error of the translation over silent windows; 0 if there are none.
        worst_rad: Largest error of the rotation over them.
        right: Number of placed frames that are right.
        flagged_right: Number of these that are doubtful.
    """

    windows: int
    wrong: int
    silent: int
    silent_at_s: tuple[float, ...]
    worst_m: float
    worst_rad: float
    right: int
    flagged_right: int

    @property
    def flagged_right_ratio(self) -> float:
        """Share of the right frames that are called doubtful; 0 if no frame is right."""
        return self.flagged_right / self.right if self.right else 0.0


def check_doubts(
    trajectory: Trajectory,
    records: Sequence[FrameRecord],
    truth: Trajectory,
) -> DoubtCheck:
    """Return how often a path is wrong and nothing is flagged, and how often right frames are flagged.

    A window reaches from a placed frame to the first placed one at least a second later, over gaps of the
    log too. Where every frame between has a covariance, the window is wrong only if its error is also more
    than ``WRONG_SIGMAS`` by the covariance of the relative pose, propagated from keyframe to keyframe.

    Args:
        trajectory: Solved poses of the body.
        records: Outcome of every frame of the log, in time order.
        truth: True poses of the body.
    """
    of_stamp = {stamp_ns: i for i, stamp_ns in enumerate(trajectory.stamps_ns.tolist())}
    stamps_ns = stamps_of(records)
    placed = np.array([r.stamp_ns in of_stamp and r.node is not None for r in records], dtype=np.bool_)
    flagged = ~placed | np.array([record.outcome != "tracked" for record in records], dtype=np.bool_)
    index = [of_stamp.get(record.stamp_ns, 0) for record in records]
    poses = trajectory.T_world_body[index].reshape(-1, 4, 4)
    partner, gap_ns = nearest(truth.stamps_ns, stamps_ns)
    T_truth: Array = truth.T_world_body[partner]
    known = np.flatnonzero(placed & (gap_ns <= MAX_TRUTH_GAP_NS))
    ends = np.searchsorted(stamps_ns[known], stamps_ns[known] + _WINDOW_NS)
    has_end = ends < len(known)
    windows = list(zip(known[has_end].tolist(), known[ends[has_end]].tolist(), strict=True))
    wrong = list(_wrong_windows(windows, records, placed, poses, T_truth))
    flags_before = np.concatenate([[0], np.cumsum(flagged)])
    silent = [window for window in wrong if flags_before[window.last + 1] == flags_before[window.first]]
    right = _right(poses, T_truth, known, flagged)
    return DoubtCheck(
        windows=len(windows),
        wrong=len(wrong),
        silent=len(silent),
        silent_at_s=tuple(float(stamps_ns[window.first] - stamps_ns[0]) / NS_PER_S for window in silent),
        worst_m=max((window.error_m for window in silent), default=0.0),
        worst_rad=max((window.error_rad for window in silent), default=0.0),
        right=int(right.sum()),
        flagged_right=int((right & flagged[known]).sum()),
    )


class _WrongWindow(NamedTuple):
    first: int
    last: int
    error_m: float
    error_rad: float


def _wrong_windows(
    windows: Iterable[tuple[int, int]],
    records: Sequence[FrameRecord],
    placed: NDArray[np.bool_],
    poses: Array,
    T_truth: Array,
) -> Iterator[_WrongWindow]:
    """Yield the windows whose error is large and, where covariances are known, not explained by them."""
    for a, b in windows:
        twist_rad, twist_m = _error(poses, T_truth, a, b)
        error_m, error_rad = float(np.linalg.norm(twist_m)), float(np.linalg.norm(twist_rad))
        if error_m <= WRONG_M and error_rad <= WRONG_RAD:
            continue
        covariance = _covariance(records, placed, poses, a, b)
        error = np.concatenate([twist_rad, twist_m])
        if covariance is None or _sigmas(error, covariance) > WRONG_SIGMAS:
            yield _WrongWindow(a, b, error_m, error_rad)


def _error(poses: Array, T_truth: Array, a: int, b: int) -> tuple[Array, Array]:
    """Return the error of b's pose relative to a's, rotation and translation, in b's own frame."""
    T_a_b, T_true_a_b = inverse(poses[a]) @ poses[b], inverse(T_truth[a]) @ T_truth[b]
    return log(inverse(T_true_a_b) @ T_a_b)


def _covariance(
    records: Sequence[FrameRecord], placed: NDArray[np.bool_], poses: Array, a: int, b: int
) -> Array | None:
    """Return the (6, 6) covariance of b's pose relative to a's in b's tangent; None if a part is unknown.

    It is that of a relative to its keyframe, of every keyframe on the way relative to the one before, and of
    b relative to its keyframe, as if they were independent.
    """
    first, last = records[a].node, records[b].node
    assert first is not None
    assert last is not None
    parts = [i for i in (a, b) if not records[i].is_keyframe]
    for i in range(a + 1, b + 1):
        node = records[i].node
        if placed[i] and records[i].is_keyframe and node is not None and first < node <= last:
            parts.append(i)
    total = np.zeros((6, 6))
    for i in parts:
        sigmas = records[i].sigmas
        if sigmas is None:
            return None
        Ad_b_i = adjoint(inverse(poses[b]) @ poses[i])
        total += Ad_b_i @ np.diag(np.square(sigmas)) @ Ad_b_i.T
    return total if parts else None


def _sigmas(error: Array, covariance: Array) -> float:
    return float(np.sqrt(error @ np.linalg.solve(covariance + 1e-12 * np.eye(6), error)))


def _right(
    poses: Array, T_truth: Array, known: NDArray[np.intp], flagged: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which placed frames lie where they should, seen from the nearest one that has no doubt."""
    sure = known[~flagged[known]]
    right = np.zeros(len(known), np.bool_)
    for k, frame in enumerate(known.tolist()):
        others = sure[sure != frame]
        if not len(others):
            continue
        other = int(others[np.abs(others - frame).argmin()])
        error_rad, error_m = _error(poses, T_truth, other, frame)
        right[k] = np.linalg.norm(error_m) <= RIGHT_M and np.linalg.norm(error_rad) <= RIGHT_RAD
    return right
