"""Online estimators of the node poses, corrected by the loops found while a log is still being tracked."""

from typing import Literal, Protocol

import numpy as np

from mapper.core.geometry import Transform, inverse
from mapper.graph.incremental import IncrementalSolver
from mapper.graph.model import PoseGraph
from mapper.graph.proportional_correction import spread
from mapper.loops.closure import Discrepancy, LoopClosure, discrepancy, exceeds
from mapper.loops.nearby_proposer import NodePoses
from mapper.odometry.base import FrameResult

Correction = Literal["batch", "proportional", "none"]
"""Solver of the final graph (``graph.solve``)."""

_WORTH_SOLVING = Discrepancy(translation_m=0.02, rotation_rad=0.01)
"""A loop that moves no node farther waits to be solved with the next that does."""


class OnlinePoseEstimator(NodePoses, Protocol):
    """Online pose estimator: node poses that loops correct.

    A new node's pose follows from the current estimate of the node that it was tracked from.
    """

    def add(self, node: int, track: FrameResult) -> None:
        """Add a new node, in time order."""
        ...

    def preload(self, graph: PoseGraph) -> None:
        """Add an earlier session, solved, before anything else."""
        ...

    def close(self, closure: LoopClosure) -> None:
        """Correct the path by a loop."""
        ...


class IncrementalPoseEstimator:
    """Pose estimator by incremental smoothing (iSAM2, Kaess et al. 2012), run when a loop moves enough."""

    def __init__(self) -> None:
        self._solver = IncrementalSolver()
        self._T_world_node: dict[int, Transform] = {}
        self.corrections = 0

    def preload(self, graph: PoseGraph) -> None:
        """Add an earlier session, solved, before anything else."""
        for node, T_world_node in graph.T_world_node.items():
            self._solver.add_node(node, T_world_node)
        self._solver.add_factors(graph.factors)
        self._solver.update()
        self._T_world_node = self._solver.poses()

    def add(self, node: int, track: FrameResult) -> None:
        """Add a new node, in time order."""
        self._T_world_node[node] = _first_estimate(track, self._T_world_node)
        self._solver.add_node(node, self._T_world_node[node])
        self._solver.add_factors(track.links)

    def close(self, closure: LoopClosure) -> None:
        """Correct the path by a loop."""
        factor = closure.factor
        self._solver.add_factors([factor])
        miss = discrepancy(factor.T_i_j, self._T_world_node[factor.i], self._T_world_node[factor.j])
        if exceeds(miss, _WORTH_SOLVING):
            self._solver.update()
            self._T_world_node = self._solver.poses()
            self.corrections += 1

    def pose_of(self, node: int) -> Transform:
        """Return the (4, 4) current estimate of a node's pose."""
        return self._T_world_node[node]


class ProportionalPoseEstimator:
    """Pose estimator by proportional correction of the odometry's path (Somlyai, PhD thesis, §4.3)."""

    def __init__(self) -> None:
        self._T_world_node: dict[int, Transform] = {}
        self.corrections = 0
        self._last: tuple[int, Transform] | None = None

    def preload(self, graph: PoseGraph) -> None:
        """Add an earlier session, solved, before anything else."""
        self._T_world_node |= graph.T_world_node

    def add(self, node: int, track: FrameResult) -> None:
        """Add a new node, in time order, at the odometry's motion since the last one."""
        self._T_world_node[node] = track.T_world_body
        if self._last is not None:
            last, T_odometry_last = self._last
            self._T_world_node[node] = (
                self._T_world_node[last] @ inverse(T_odometry_last) @ track.T_world_body
            )
        self._last = node, track.T_world_body

    def close(self, closure: LoopClosure) -> None:
        """Correct the path by a loop."""
        self._T_world_node = spread(self._T_world_node, closure.factor)
        self.corrections += 1

    def pose_of(self, node: int) -> Transform:
        """Return the (4, 4) current estimate of a node's pose."""
        return self._T_world_node[node]


def _first_estimate(track: FrameResult, T_world_node: dict[int, Transform]) -> Transform:
    """Return the pose by the surest link to an earlier node; by the odometry, if there is none."""
    if not track.links:
        return track.T_world_body
    link = min(track.links, key=lambda link: float(np.trace(np.linalg.inv(link.information))))
    return T_world_node[link.i] @ link.T_i_j


def build_pose_estimator(correction: Correction) -> OnlinePoseEstimator:
    """Return the estimator that corrects as the graph will be solved."""
    return ProportionalPoseEstimator() if correction == "proportional" else IncrementalPoseEstimator()
