"""Loop metrics: how many closures are right, how many true revisits they found, how they agree."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, distances_along, inverse, log
from mapper.core.timebase import MAX_TRUTH_GAP_NS, NS_PER_S, Stamps, nearest
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.metric import Metric
from mapper.graph.config import GraphConfig
from mapper.graph.marginals import marginals_of
from mapper.graph.measurement_covariance import LIMIT_CHI2
from mapper.graph.model import PoseGraph
from mapper.graph.optimize import optimize
from mapper.loops.closure import LoopClosure, accepted_loops, discrepancy
from mapper.loops.config import ScanLoopsConfig
from mapper.run.folder import Run

MAX_ERROR_M, MAX_ERROR_RAD = 0.2, 0.1
"""A loop that is farther from the truth is wrong."""
REVISIT_M, REVISIT_RAD, REVISIT_S = 0.5, np.deg2rad(20.0), 5.0
"""A keyframe revisits a place if an earlier one was within this distance and turn, and before this time."""


def loop_metrics_of_run(run: Run, truth: Trajectory) -> list[Metric]:
    """Return the loop metrics of a run, whose scans are searched for loops once in some metres."""
    loops = run.config.loops
    searched_every_m = loops.min_motion_m if isinstance(loops, ScanLoopsConfig) else 0.0
    return loop_metrics(run.loops, run.keyframes.stamps_ns, truth, searched_every_m=searched_every_m)


def loop_metrics(
    loops: Sequence[LoopClosure], keyframes_ns: Stamps, truth: Trajectory, *, searched_every_m: float = 0.0
) -> list[Metric]:
    """Return how many loops hold, how many of them are wrong, and how many true revisits have one.

    Args:
        loops: Every candidate with its verdict.
        keyframes_ns: (N,) int64 stamps of all nodes, in time order.
        truth: True poses of the body; loops that it does not cover are left out.
        searched_every_m: Distance that a run went between two searches for loops: a loop found from so near
            counts for a keyframe too.
    """
    accepted = accepted_loops(loops)
    revisits = revisits_of(keyframes_ns, truth)
    along_m = _along(keyframes_ns, truth)
    found_m = along_m[np.isin(keyframes_ns, [loop.stamp_j_ns for loop in accepted])]
    found = (np.abs(along_m[:, np.newaxis] - found_m) <= searched_every_m).any(axis=1)
    return [
        Metric("loops", len(accepted), "loops"),
        Metric("loops wrongly accepted", sum(wrong_loops(accepted, truth)), "loops"),
        Metric("true revisits", int(revisits.sum()), "keyframes"),
        Metric("true revisits with a loop", int((found & revisits).sum()), "keyframes"),
    ]


def agreement_of_loops(graph: PoseGraph) -> list[Metric]:
    """Return how far each loop is from the pose that all others and the odometry give; nothing without loops.

    Each loop is left out in turn. It need not be solved for: the covariance P of its two nodes relative to
    each other is that of two independent estimates, the loop's and all others', so the others' has the
    covariance (P⁻¹ − Ω)⁻¹, and the residual without the loop is larger by the factor by which that exceeds P
    (Cook 1977). The squared residual by its covariance has six degrees of freedom; a loop beyond their 99.9 %
    contradicts the others. Loops that alone tie their nodes are not compared.

    Args:
        graph: With the loops that hold. It is solved first: poses that were adjusted to planes or by hand are
            not its own.
    """
    if not graph.loops:
        return []
    graph = graph.with_poses(optimize(graph, GraphConfig(robust="none")).T_world_node)
    relative = marginals_of(graph).relative
    distances_m, angles_rad, squares = [], [], []
    for loop in graph.loops:
        try:
            others = np.linalg.inv(np.linalg.inv(relative[loop.i, loop.j]) - loop.information)
            covariance = others + np.linalg.inv(loop.information)
            np.linalg.cholesky(others)
        except np.linalg.LinAlgError:
            continue
        T_i_j = inverse(graph.T_world_node[loop.i]) @ graph.T_world_node[loop.j]
        left_out = covariance @ loop.information @ np.concatenate(log(inverse(T_i_j) @ loop.T_i_j))
        angles_rad.append(float(np.linalg.norm(left_out[:3])))
        distances_m.append(float(np.linalg.norm(left_out[3:])))
        squares.append(float(left_out @ np.linalg.solve(covariance, left_out)))
    if not squares:
        return []
    contradicting = sum(square > LIMIT_CHI2 for square in squares)
    return [
        Metric("loops compared with all others", len(squares), "loops"),
        Metric("loops off the others, median", float(np.median(distances_m)), "m"),
        Metric("loops off the others, largest", max(distances_m), "m"),
        Metric("loops off the others, median angle", float(np.median(angles_rad)), "rad"),
        Metric("loops that contradict the others", contradicting, "loops"),
    ]


def revisits_of(keyframes_ns: Stamps, truth: Trajectory) -> NDArray[np.bool_]:
    """Return (N,) which keyframes revisit, by the truth, the place of an earlier one."""
    index, gap_ns = nearest(truth.stamps_ns, keyframes_ns)
    known = gap_ns <= MAX_TRUTH_GAP_NS
    T_truth_body: Array = truth.T_world_body[index]
    revisit = np.zeros(len(keyframes_ns), np.bool_)
    for j in np.flatnonzero(known):
        old = known[:j] & (keyframes_ns[j] - keyframes_ns[:j] >= REVISIT_S * NS_PER_S)
        earlier = T_truth_body[:j][old]
        near = np.linalg.norm(earlier[:, :3, 3] - T_truth_body[j, :3, 3], axis=1) <= REVISIT_M
        cosine = 0.5 * (np.einsum("nij,ij->n", earlier[:, :3, :3], T_truth_body[j, :3, :3]) - 1.0)
        revisit[j] = (near & (cosine >= np.cos(REVISIT_RAD))).any()
    return revisit


def _along(keyframes_ns: Stamps, truth: Trajectory) -> Array:
    index, _ = nearest(truth.stamps_ns, keyframes_ns)
    return distances_along(truth.positions_world)[index]


def wrong_loops(accepted: Sequence[LoopClosure], truth: Trajectory) -> list[bool]:
    """Return for each loop that the truth covers whether its measurement is wrong."""
    stamps_ns = np.array([(loop.stamp_i_ns, loop.stamp_j_ns) for loop in accepted], np.int64).reshape(-1, 2)
    index, gap_ns = nearest(truth.stamps_ns, stamps_ns.ravel())
    ends = index.reshape(-1, 2)
    known = (gap_ns <= MAX_TRUTH_GAP_NS).reshape(-1, 2)
    wrong = []
    for loop, (i, j), covered in zip(accepted, ends, known, strict=True):
        if covered.all() and loop.T_i_j is not None:
            miss = discrepancy(loop.T_i_j, truth.T_world_body[i], truth.T_world_body[j])
            wrong.append(miss.translation_m > MAX_ERROR_M or miss.rotation_rad > MAX_ERROR_RAD)
    return wrong
