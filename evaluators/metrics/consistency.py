"""Covariances of poses: normalised estimation error squared (NEES), and the drift to be expected by them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array, Transform, adjoint, inverse, log
from mapper.core.timebase import MAX_TRUTH_GAP_NS, NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.metric import Metric
from mapper.graph.marginals import marginals_of
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.run.frame_records import FrameRecord, stamps_of
from mapper.run.pose_covariances import UncertainPoses
from mapper.sensing.wheel_kinematics import pose_at

_NEXT_TO_NOTHING = 1e-6 * np.eye(6)
"""Information of factors that only serve to query the covariance of two nodes relative to each other."""
_MOST_WINDOWS = 300  # spread over the log: the covariance of each takes a while


@dataclass(frozen=True, slots=True)
class Nees:
    """NEES per degree of freedom: 1 if covariances are as large as the errors, more if they are too small.

    Attributes:
        mean: Over the relative poses; NaN without any.
        median: Over them; 0.89 if the covariances are right.
        count: Number of them.
    """

    mean: float
    median: float
    count: int


def window_nees(
    trajectory: Trajectory,
    graph: PoseGraph,
    records: Sequence[FrameRecord],
    truth: Trajectory,
    *,
    window_ns: int = NS_PER_S,
) -> Nees:
    """Return the NEES of poses relative to those some time before (Bar-Shalom, Li & Kirubarajan 2001).

    Args:
        trajectory: Solved poses of the body.
        graph: Solved, with the factors that hold.
        records: Outcome of every frame; frames without sigmas are left out.
        truth: True poses of the body, interpolated to the frames' stamps.
        window_ns: Least time between the two, a second or, with 1, that of a step from frame to frame.
    """
    pose_of = dict(trajectory.items())
    known = [
        (record, T_true)
        for record in records
        if record.outcome == "tracked"
        and (record.sigmas is not None or record.is_keyframe)
        and record.stamp_ns in pose_of
        and (T_true := _true_pose(truth, record.stamp_ns)) is not None
    ]
    stamps_ns = stamps_of(record for record, _ in known)
    ends = np.searchsorted(stamps_ns, stamps_ns + window_ns)
    begins = np.flatnonzero(ends < len(known))
    begins = begins[:: max(1, len(begins) // _MOST_WINDOWS)]
    windows = [(known[a], known[int(ends[a])]) for a in begins]
    relative = _relative_covariances(graph, [(a.node, b.node) for (a, _), (b, _) in windows])
    errors = []
    for (a, T_true_a), (b, T_true_b) in windows:
        T_a_b = inverse(pose_of[a.stamp_ns]) @ pose_of[b.stamp_ns]
        assert a.node is not None
        assert b.node is not None
        T_b_node = inverse(pose_of[b.stamp_ns]) @ graph.T_world_node[b.node]
        covariance = _carried(relative[a.node, b.node], T_b_node) if a.node != b.node else np.zeros((6, 6))
        covariance = covariance + _own(b) + _carried(_own(a), inverse(T_a_b))
        errors.append(_nees(T_a_b, inverse(T_true_a) @ T_true_b, covariance))
    return _summary(errors)


def drift_metrics(poses: UncertainPoses) -> list[Metric]:
    """Return the drift to be expected by the covariances, which needs no truth; nothing where unknown."""
    path_m = poses.trajectory.path_length_m
    if not (path_m > 0.0 and np.isfinite(poses.end_sigma_m)):
        return []
    return [
        Metric("uncertainty of the last position", poses.end_sigma_m, "m", "1 σ"),
        Metric("expected drift", 100.0 * poses.end_sigma_m / path_m, "%", "1 σ"),
    ]


def factor_nees(factors: Sequence[BetweenFactor], graph: PoseGraph, truth: Trajectory) -> Nees:
    """Return the NEES of measured relative poses between a graph's nodes."""
    true = {node: _true_pose(truth, stamp_ns) for node, stamp_ns in graph.stamps_ns.items()}
    errors = []
    for factor in factors:
        T_true_i, T_true_j = true[factor.i], true[factor.j]
        if T_true_i is not None and T_true_j is not None:
            covariance = np.asarray(np.linalg.inv(factor.information), np.float64)
            errors.append(_nees(factor.T_i_j, inverse(T_true_i) @ T_true_j, covariance))
    return _summary(errors)


def _nees(T_measured: Transform, T_true: Transform, covariance: Array) -> float:
    error = np.concatenate(log(inverse(T_measured) @ T_true))
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def _summary(errors: Sequence[float]) -> Nees:
    if not errors:
        return Nees(np.nan, np.nan, 0)
    return Nees(float(np.mean(errors)), float(np.median(errors)), len(errors))


def _own(record: FrameRecord) -> Array:
    """Return the (6, 6) covariance of a frame's pose relative to its node."""
    if record.is_keyframe or record.sigmas is None:
        return np.zeros((6, 6))
    return np.diag(np.square(record.sigmas))


def _carried(covariance: Array, T_to_from: Transform) -> Array:
    """Return a covariance in the tangent of another body that is rigidly connected."""
    carry = adjoint(T_to_from)
    return carry @ covariance @ carry.T


def _relative_covariances(
    graph: PoseGraph, pairs: Sequence[tuple[int | None, int | None]]
) -> dict[tuple[int, int], Array]:
    wanted = {(i, j) for i, j in pairs if i is not None and j is not None and i != j}
    asking = [
        BetweenFactor(i, j, inverse(graph.T_world_node[i]) @ graph.T_world_node[j], _NEXT_TO_NOTHING)
        for i, j in sorted(wanted)
    ]
    return marginals_of(graph.with_factors([*graph.factors, *asking])).relative


def _true_pose(truth: Trajectory, stamp_ns: int) -> Transform | None:
    """Return the truth at a time, interpolated; None outside of it and in its gaps."""
    return pose_at(truth, stamp_ns, max_gap_ns=2 * MAX_TRUTH_GAP_NS)
