"""Drift gate: loops that odometry and wheels rule out are rejected, and many that agree are reported."""

from statistics import median

import numpy as np

from mapper.core.geometry import inverse
from mapper.graph.measurement_covariance import Comparison, compare
from mapper.loops.closure import LoopClosure
from mapper.loops.config import GateConfig
from mapper.loops.consistency_check import ConsistencyCheck
from mapper.loops.odometry_drift import OdometryChain, allowed
from mapper.loops.online_pose_estimator import OnlinePoseEstimator


class DriftGate:
    """Drift gate: compares measured loops with the current estimate of the poses.

    A loop is possible if it lies within what the steps between its nodes leave uncertain, by the covariances
    of odometry and wheels, and what the path's length allows for errors that no covariance describes.
    """

    def __init__(
        self,
        config: GateConfig,
        chain: OdometryChain,
        estimator: OnlinePoseEstimator,
        rejected: ConsistencyCheck,
    ) -> None:
        """Start without loops.

        Args:
            config: Errors by the path's length.
            chain: Factors between the nodes.
            estimator: Poses of the nodes.
            rejected: Empty; finds those rejected loops that agree with each other.
        """
        self._config = config
        self._chain = chain
        self._estimator = estimator
        self._rejected = rejected
        self._conflicts: dict[bool, list[LoopClosure]] = {True: [], False: []}
        self._compared: dict[tuple[int, int], tuple[Comparison, bool]] = {}

    def checked(self, closure: LoopClosure) -> LoopClosure:
        """Return a measured loop as it is, or rejected if odometry and wheels cannot have drifted by it."""
        if closure.T_i_j is None or closure.information is None:
            return closure
        drift = self._chain.between(closure.i, closure.j)
        if drift is None:
            return closure
        limit = allowed(self._config, drift.path)
        comparison = compare(
            closure.T_i_j,
            inverse(self._estimator.pose_of(closure.i)) @ self._estimator.pose_of(closure.j),
            drift.covariance + np.linalg.inv(closure.information),
            slack_m=limit.translation_m,
            slack_rad=limit.rotation_rad,
        )
        if comparison.is_possible:
            return closure
        self._compared[closure.i, closure.j] = comparison, drift.by_wheels
        for agreeing in self._rejected.add(closure):
            self._conflicts[self._compared[agreeing.i, agreeing.j][1]].append(agreeing)
        source = "wheels and odometry" if drift.by_wheels else "odometry"
        return closure.rejected("gate", f"{comparison}, after {drift.path.path_m:.1f} m of path by {source}")

    def notes(self) -> list[str]:
        """Return a sentence about the rejected loops that agree with each other, if there are many."""
        return [
            _note([self._compared[loop.i, loop.j][0] for loop in loops], by_wheels)
            for by_wheels, loops in self._conflicts.items()
            if loops
        ]


def _note(comparisons: list[Comparison], by_wheels: bool) -> str:
    miss_m = median(comparison.translation_m for comparison in comparisons)
    miss_rad = median(comparison.rotation_rad for comparison in comparisons)
    but, why = (
        ("the wheels", "or did the wheels slip (graph.wheels.use=false maps without them)?")
        if by_wheels
        else ("the odometry", "or did the odometry jump (loops.gate allows more drift)?")
    )
    return (
        f"{len(comparisons)} loops agree with each other but not with {but}: median {miss_m:.2f} m and "
        f"{miss_rad:.2f} rad off; they are rejected. Do two places look alike, {why}"
    )
