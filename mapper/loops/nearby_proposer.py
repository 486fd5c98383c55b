"""Proposer of places that are near by the current estimate of the poses, and two proposers combined."""

from collections.abc import Callable
from typing import Generic, Protocol

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform
from mapper.loops.base import Place, Proposal, Proposer


class NodePoses(Protocol):
    """Source of the current estimates of nodes' poses."""

    @property
    def corrections(self) -> int:
        """Number of times that the poses of known nodes have changed."""
        ...

    def pose_of(self, node: int) -> Transform:
        """Return the (4, 4) current estimate of a node's pose."""
        ...


class PoseProposer(Generic[Place]):
    """Pose proposer: places seen from nearby in nearly the same direction (Somlyai, PhD thesis, §4.3)."""

    def __init__(
        self,
        estimator: NodePoses,
        pose_of_sensor: Callable[[Place], Transform],
        *,
        max_distance_m: float,
        max_angle_rad: float,
        drift_ratio: float,
    ) -> None:
        """Start without places.

        Args:
            estimator: Poses of the nodes.
            pose_of_sensor: Returns T_body_sensor, whose z is the viewing direction.
            max_distance_m: Largest distance between two positions.
            max_angle_rad: Largest angle between two viewing directions.
            drift_ratio: Added to the distance per metre travelled since.
        """
        self._estimator = estimator
        self._pose_of_sensor = pose_of_sensor
        self._max_distance_m = max_distance_m
        self._max_angle_rad = max_angle_rad
        self._drift_ratio = drift_ratio
        self._nodes: list[int] = []
        self._T_body_sensor = np.empty((1, 4, 4))
        self._T_world_sensor = np.empty((1, 4, 4))
        self._travelled_m = np.empty(1)
        self._placed, self._corrections = 0, estimator.corrections

    def within_reach(self, node: int, seen: Place, /, *, before: int) -> NDArray[np.bool_]:
        """Return which of the first ``before`` places may be nearby, in any viewing direction."""
        distance_m, _ = self._apart(node, seen, before)
        return distance_m <= self._reach_m(before)

    def propose(self, node: int, seen: Place, /, *, before: int, limit: int) -> list[Proposal]:
        """Return the nearest places, the nearest first: metres and radians count alike."""
        distance_m, angle_rad = self._apart(node, seen, before)
        near = distance_m <= self._reach_m(before)
        candidates = np.flatnonzero(near & (angle_rad <= self._max_angle_rad))
        apart = distance_m[candidates] + angle_rad[candidates]
        nearest = candidates[np.argsort(apart, kind="stable")[:limit]]
        return [Proposal(self._nodes[k], "nearby") for k in nearest.tolist()]

    def add(self, node: int, seen: Place) -> None:
        """Add a place."""
        row, travelled_m = len(self._nodes), 0.0
        if row:
            step = self._estimator.pose_of(node)[:3, 3] - self._estimator.pose_of(self._nodes[-1])[:3, 3]
            travelled_m = self._travelled_m[row - 1] + float(np.linalg.norm(step))
        if row == len(self._travelled_m):
            self._T_body_sensor = _doubled(self._T_body_sensor)
            self._T_world_sensor = _doubled(self._T_world_sensor)
            self._travelled_m = _doubled(self._travelled_m)
        self._nodes.append(node)
        self._T_body_sensor[row] = self._pose_of_sensor(seen)
        self._travelled_m[row] = travelled_m

    def _apart(self, node: int, seen: Place, before: int) -> tuple[Array, Array]:
        """Return the distances of the places from a node's, metres, and the angles between their views."""
        T_world_here = self._estimator.pose_of(node) @ self._pose_of_sensor(seen)
        self._place(before)
        T_world_place = self._T_world_sensor[:before]
        distance_m = np.linalg.norm(T_world_place[:, :3, 3] - T_world_here[:3, 3], axis=1)
        angle_rad = np.arccos(np.clip(T_world_place[:, :3, 2] @ T_world_here[:3, 2], -1.0, 1.0))
        return distance_m, angle_rad

    def _place(self, before: int) -> None:
        """Look up the poses of the first places that are not known yet, or have changed."""
        if self._corrections != self._estimator.corrections:
            self._placed, self._corrections = 0, self._estimator.corrections
        if before <= self._placed:
            return
        new = slice(self._placed, before)
        T_world_body = np.array([self._estimator.pose_of(node) for node in self._nodes[new]])
        self._T_world_sensor[new] = T_world_body @ self._T_body_sensor[new]
        self._placed = before

    def _reach_m(self, before: int) -> Array:
        """Return the largest distance, metres, at which each place counts as nearby."""
        if not self._nodes:
            return np.empty(0)
        since_m: Array = self._travelled_m[len(self._nodes) - 1] - self._travelled_m[:before]
        return self._max_distance_m + self._drift_ratio * since_m


def _doubled(rows: Array) -> Array:
    """Return rows with room for as many again."""
    return np.concatenate([rows, np.empty_like(rows)])


class CombinedProposer(Generic[Place]):
    """Combined proposer: similar places and, up to the limit, those that are near."""

    def __init__(self, similar: Proposer[Place], near: PoseProposer[Place]) -> None:
        self._proposers = (similar, near)

    def propose(self, node: int, seen: Place, /, *, before: int, limit: int) -> list[Proposal]:
        """Return similar places, then near ones."""
        proposals: dict[int, Proposal] = {}
        for proposer in self._proposers:
            for proposal in proposer.propose(node, seen, before=before, limit=limit):
                proposals.setdefault(proposal.node, proposal)
        return list(proposals.values())[:limit]

    def add(self, node: int, seen: Place) -> None:
        """Add a place."""
        for proposer in self._proposers:
            proposer.add(node, seen)
