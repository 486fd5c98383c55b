"""Doubtful frames: placed by the tracked frames around them, and kept out of the maps."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array, Transform, exp, interpolate, inverse, log, transform
from mapper.core.rotations import rotation_from_quaternion
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory
from mapper.graph.model import PoseGraph
from mapper.run.frame_outcomes import FrameRecord

MAX_GAP_NS = 2 * NS_PER_S
"""Tracked frames that are farther apart say little about what lies between them."""

_WINDOWS = 200
_MIN_WINDOWS = 3
_LEAST_VARIANCE = 1e-8
"""(0.1 mm)² and (0.1 mrad)²: a path that is smoother than that is a synthetic one."""


def without_doubtful(trajectory: Trajectory, records: Iterable[FrameRecord]) -> Trajectory:
    """Return the poses of the frames whose outcome is not "doubtful": those that maps are made from."""
    doubtful = [record.stamp_ns for record in records if record.outcome == "doubtful"]
    if not doubtful:
        return trajectory
    kept = ~np.isin(trajectory.stamps_ns, doubtful)
    return Trajectory(trajectory.stamps_ns[kept], trajectory.T_world_body[kept])


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
    """Return, by stamp, where each doubtful frame lies that is no node.

    The frame gets the information-weighted mean of two estimates, in the tangent of the first: its own pose,
    T_world_node · T_node_body with the covariance of its tracking, and the motion at constant velocity from
    the tracked frame before it to the one after it. How far off the latter is, is measured on this log's
    tracked frames, over gaps of the same duration. A frame whose own covariance is unknown goes where
    the motion leads; one without tracked frames around it, at most ``MAX_GAP_NS`` apart, keeps its own pose.

    Args:
        trajectory: Poses of all frames that were placed, in the world of the graph.
        graph: Nodes at their solution.
        records: Outcome of every frame.
    """
    tracked = without_doubtful(trajectory, records)
    by_motion: dict[int, Array | None] = {}
    estimates = {}
    for record in records:
        if record.node is None or record.pose_in_node is None:
            continue
        position, quaternion = np.split(np.array(record.pose_in_node), [3])
        T_own = graph.T_world_node[record.node] @ transform(rotation_from_quaternion(quaternion), position)
        own = Estimate(T_own, None if record.sigmas is None else np.square(record.sigmas))
        estimates[record.stamp_ns] = _between(record.stamp_ns, own, tracked, by_motion)
    return estimates


def _between(
    stamp_ns: int, own: Estimate, tracked: Trajectory, middle_variances: dict[int, Array | None]
) -> Estimate:
    """Return the mean of a frame's own pose and the motion around it; adds to ``middle_variances``."""
    after = int(np.searchsorted(tracked.stamps_ns, stamp_ns))
    if not 0 < after < len(tracked):
        return own
    begin_ns, end_ns = (int(stamp_ns) for stamp_ns in tracked.stamps_ns[[after - 1, after]])
    gap_ns = end_ns - begin_ns
    if gap_ns > MAX_GAP_NS:
        return own
    if gap_ns not in middle_variances:
        middle_variances[gap_ns] = _middle_variances(tracked, gap_ns)
    at_middle = middle_variances[gap_ns]
    if at_middle is None:
        return own
    fraction = (stamp_ns - begin_ns) / gap_ns
    T_moved = interpolate(tracked.T_world_body[after - 1], tracked.T_world_body[after], fraction)
    # Under a constant acceleration the error of the straight line grows as f · (1 − f).
    by_motion = at_middle * (4.0 * fraction * (1.0 - fraction)) ** 2 + _LEAST_VARIANCE
    if own.variances is None:
        return Estimate(T_moved, by_motion)
    weight = own.variances / (own.variances + by_motion)
    step = weight * np.concatenate(log(inverse(own.T_world_body) @ T_moved))
    return Estimate(own.T_world_body @ exp(step[:3], step[3:]), weight * by_motion)


def _middle_variances(tracked: Trajectory, gap_ns: int) -> Array | None:
    """Return how far frames lie from the middle of a gap, by constant velocity, where they were tracked.

    Returns:
        (6,) variances of the tangent (rotation, translation), alike in all directions; None if the log has
        too few frames that lie so.
    """
    stamps_ns, poses = tracked.stamps_ns, tracked.T_world_body
    ends = np.searchsorted(stamps_ns, stamps_ns + gap_ns)
    begins = np.flatnonzero(ends < len(stamps_ns))
    ends = ends[begins]
    middles = np.searchsorted(stamps_ns, (stamps_ns[begins] + stamps_ns[ends]) // 2)
    usable = (stamps_ns[ends] - stamps_ns[begins] <= 1.5 * gap_ns) & (begins < middles) & (middles < ends)
    windows = np.column_stack([begins, middles, ends])[usable]
    if len(windows) < _MIN_WINDOWS:
        return None
    chosen = windows[np.unique(np.linspace(0, len(windows) - 1, _WINDOWS).astype(int))]
    apart = np.array(
        [
            np.concatenate(log(inverse(_line(stamps_ns, poses, begin, middle, end)) @ poses[middle]))
            for begin, middle, end in chosen.tolist()
        ]
    )
    squares = np.square(apart).reshape(-1, 2, 3).mean(axis=(0, 2))
    return np.repeat(squares, 3)


def _line(stamps_ns: Stamps, poses: Array, begin: int, middle: int, end: int) -> Transform:
    fraction = float(stamps_ns[middle] - stamps_ns[begin]) / float(stamps_ns[end] - stamps_ns[begin])
    return interpolate(poses[begin], poses[end], fraction)
