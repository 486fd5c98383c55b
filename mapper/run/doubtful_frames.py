"""Doubtful frames: placed by the tracked frames around them, and kept out of the maps."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapper.core.geometry import Array, Transform, exp, interpolate, inverse, log, spread_indices
from mapper.core.rotations import pose_of_row
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.graph.model import PoseGraph
from mapper.run.frame_records import FrameRecord

MAX_GAP_NS = 2 * NS_PER_S
"""Where tracked frames are farther apart, a frame keeps its own pose, unless its image is a repeated one."""

_VELOCITY_NS = NS_PER_S // 10
"""Time over which the velocity at the ends of a gap is measured, at least: half and double are as good."""
_CLEARLY = 2.0
"""The cubic is followed where its variance is this many times less than that of the line: next to a gap that
a loop has opened the velocity is wrong."""
_WINDOWS = 50
_MIN_WINDOWS = 3
_LEAST_VARIANCE = 1e-8
"""(0.1 mm)² and (0.1 mrad)²: a path that is smoother than that is a synthetic one."""


def without_doubtful(trajectory: Trajectory, records: Iterable[FrameRecord]) -> Trajectory:
    """Return the poses of the frames whose outcome is not "doubtful": those that maps are made from."""
    doubtful = [record.stamp_ns for record in records if record.outcome == "doubtful"]
    if not doubtful:
        return trajectory
    return trajectory[~np.isin(trajectory.stamps_ns, doubtful)]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Pose of a doubtful frame.

    Attributes:
        T_world_body: (4, 4) in the world of the graph.
        variances: (6,) relative to the node, tangent of the body (rotation, translation); None if unknown.
    """

    T_world_body: Transform
    variances: Array | None


def placed_by_neighbours(
    trajectory: Trajectory, graph: PoseGraph, records: Sequence[FrameRecord]
) -> Trajectory:
    """Return the trajectory with the estimates of ``estimates_of_doubtful`` in it."""
    estimates = estimates_of_doubtful(trajectory, graph, records)
    if not estimates:
        return trajectory
    T_world_body = trajectory.T_world_body.copy()
    for index, stamp_ns in enumerate(trajectory.stamps_ns.tolist()):
        if stamp_ns in estimates:
            T_world_body[index] = estimates[stamp_ns].T_world_body
    return Trajectory(trajectory.stamps_ns, T_world_body)


def estimates_of_doubtful(
    trajectory: Trajectory, graph: PoseGraph, records: Sequence[FrameRecord]
) -> dict[int, Estimate]:
    """Return, by stamp, the pose of each doubtful frame that is not a node.

    The frame gets the information-weighted mean of two estimates, in the tangent of the first: its own pose,
    T_world_node · T_node_body with the covariance of its tracking, and the motion from the tracked frame
    before it to the one after it. That motion has a constant velocity, or follows a cubic with the path's
    velocity at both ends where this errs clearly less. Both errors are measured on this log's tracked frames,
    over gaps of the same duration. A frame whose own covariance is unknown gets the motion's pose; one
    without tracked frames around it, or in a gap as long as the log's tracked stretches, keeps its own pose,
    as do others in gaps of more than ``MAX_GAP_NS`` unless their image repeats.

    Args:
        trajectory: Poses of all frames that were placed, in the world of the graph.
        graph: Nodes at their solution.
        records: Outcome of every frame.
    """
    motion = _MotionAround(without_doubtful(trajectory, records))
    estimates = {}
    for record in records:
        if record.node is None or record.pose_in_node is None:
            continue
        T_own = graph.T_world_node[record.node] @ pose_of_row(np.array(record.pose_in_node))
        own = Estimate(T_own, None if record.sigmas is None else np.square(record.sigmas))
        estimates[record.stamp_ns] = motion.combined_with(
            own,
            record.stamp_ns,
            is_seen=all(doubt.kind != "repeated image" for doubt in record.doubts),
        )
    return estimates


class _MotionAround:
    def __init__(self, tracked: Trajectory) -> None:
        self._stamps_ns, self._poses = tracked.stamps_ns, tracked.T_world_body
        self._variances: dict[int, Array | None] = {}  # at the middle, by the duration of the gap

    def combined_with(self, own: Estimate, stamp_ns: int, *, is_seen: bool) -> Estimate:
        """Return the mean of a frame's own pose and the motion around it."""
        end = int(np.searchsorted(self._stamps_ns, stamp_ns))
        if not 0 < end < len(self._stamps_ns):
            return own
        begin = end - 1
        begin_ns, end_ns = (int(self._stamps_ns[k]) for k in (begin, end))
        gap_ns = end_ns - begin_ns
        if is_seen and gap_ns > MAX_GAP_NS:
            return own
        if gap_ns not in self._variances:
            self._variances[gap_ns] = self._measured(gap_ns)
        at_middle = self._variances[gap_ns]
        if at_middle is None:
            return own
        # Under a constant acceleration the error of the line grows as f · (1 − f), and under a constant
        # change of the jerk that of the cubic as its square.
        fraction = (stamp_ns - begin_ns) / gap_ns
        growth = (4.0 * fraction * (1.0 - fraction)) ** np.array([[2], [4]])
        moved = self._moved(begin, end, stamp_ns)
        follows_cubic = (_CLEARLY * at_middle[1] < at_middle[0]) & (len(moved) > 1)
        better = follows_cubic.astype(int), np.arange(6)
        T_from = moved[0] if own.variances is None else own.T_world_body
        steps = np.array([np.concatenate(log(inverse(T_from) @ T)) for T in moved])
        variance = (at_middle * growth + _LEAST_VARIANCE)[better]
        weight = np.ones(6) if own.variances is None else own.variances / (own.variances + variance)
        step = weight * steps[better]
        return Estimate(T_from @ exp(step[:3], step[3:]), weight * variance)

    def _moved(self, begin: int, end: int, stamp_ns: int) -> list[Transform]:
        """Return poses at a time between two tracked frames: on the line, and on the cubic if there is one.

        The cubic is the Bézier curve of four poses, by de Casteljau's construction (Shoemake 1985).
        """
        stamps_ns, poses = self._stamps_ns, self._poses
        gap_ns = float(stamps_ns[end] - stamps_ns[begin])
        fraction = float(stamp_ns - stamps_ns[begin]) / gap_ns
        moved = [interpolate(poses[begin], poses[end], fraction)]
        before = int(np.searchsorted(stamps_ns, stamps_ns[begin] - _VELOCITY_NS, side="right")) - 1
        after = int(np.searchsorted(stamps_ns, stamps_ns[end] + _VELOCITY_NS))
        if before >= 0 and after < len(stamps_ns):
            curve = [poses[begin], *(poses[k] for k in (begin, end)), poses[end]]
            for k, (outer, inner) in enumerate(((before, begin), (after, end)), start=1):
                beyond = gap_ns / 3.0 / abs(float(stamps_ns[inner] - stamps_ns[outer]))
                curve[k] = interpolate(poses[outer], poses[inner], 1.0 + beyond)
            while len(curve) > 1:
                curve = [interpolate(a, b, fraction) for a, b in pairwise(curve)]
            moved += curve
        return moved

    def _measured(self, gap_ns: int) -> Array | None:
        """Return how far tracked frames lie from the middle of the motion over a gap of this duration.

        Returns:
            (2, 6) variances of the line and of the cubic in the tangent (rotation, translation), alike in all
            directions; None if the log has too few frames that lie so, or only about one time.
        """
        stamps_ns = self._stamps_ns
        ends = np.searchsorted(stamps_ns, stamps_ns + gap_ns)
        begins = np.flatnonzero(ends < len(stamps_ns))
        ends = ends[begins]
        middles_ns = (stamps_ns[begins] + stamps_ns[ends]) // 2
        middles = np.searchsorted(stamps_ns, middles_ns)
        usable = (stamps_ns[ends] - stamps_ns[begins] <= 1.5 * gap_ns) & (begins < middles) & (middles < ends)
        usable &= stamps_ns[middles] - middles_ns <= gap_ns // 4
        windows = np.column_stack([begins, middles, ends])[usable]
        if len(windows) < _MIN_WINDOWS or stamps_ns[windows[-1, 0]] - stamps_ns[windows[0, 0]] < gap_ns:
            return None
        chosen = windows[spread_indices(len(windows), _WINDOWS)]
        squares = [
            [np.square(np.concatenate(log(inverse(T) @ self._poses[middle]))) for T in moved]
            for begin, middle, end in chosen.tolist()
            if len(moved := self._moved(begin, end, int(stamps_ns[middle]))) > 1
        ]
        if len(squares) < _MIN_WINDOWS:
            return None
        means = np.mean(squares, axis=0).reshape(2, 2, 3).mean(axis=2)
        return np.repeat(means, 3, axis=1)
