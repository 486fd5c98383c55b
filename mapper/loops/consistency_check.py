"""Temporal consistency check: a loop is confirmed by loops from other keyframes nearby that agree with it."""

from dataclasses import dataclass

from mapper.core.geometry import inverse
from mapper.loops.closure import LoopClosure, exceeds, pose_difference
from mapper.loops.config import GateConfig
from mapper.loops.odometry_drift import NodePath, OdometryChain, allowed
from mapper.loops.online_pose_estimator import OnlinePoseEstimator


@dataclass(slots=True)
class _Hypothesis:
    """A measured loop and the number of others that agree with it so far."""

    closure: LoopClosure
    supporters: int = 0
    confirmed: bool = False


class ConsistencyCheck:
    """Consistency check: measured loops are hypotheses until enough others agree."""

    def __init__(
        self,
        chain: OdometryChain,
        estimator: OnlinePoseEstimator,
        gate: GateConfig,
        *,
        min_agreeing: int,
        within_m: float,
    ) -> None:
        """Start without loops.

        Args:
            chain: Factors between the nodes.
            estimator: Poses of the nodes.
            gate: Drift of the odometry between neighbours.
            min_agreeing: Number of others that must agree.
            within_m: Largest distance along the path between ends of two loops that are compared.
        """
        self._chain = chain
        self._estimator = estimator
        self._gate = gate
        self._min_agreeing = min_agreeing
        self._within_m = within_m
        self._hypotheses_from: dict[int, list[_Hypothesis]] = {}

    def add(self, closure: LoopClosure) -> list[LoopClosure]:
        """Add a measured loop; return all that are confirmed now and were not before."""
        new = _Hypothesis(closure)
        near_i = self._chain.around(closure.i, within_m=self._within_m)
        near_j = self._chain.around(closure.j, within_m=self._within_m)
        supported = []
        for j in sorted(near_j.keys() - {closure.j}):
            for hypothesis in self._hypotheses_from.get(j, ()):
                if hypothesis.confirmed and new.supporters >= self._min_agreeing:
                    continue  # neither of the two needs the other
                if self._agree(hypothesis.closure, closure, near_i, near_j):
                    new.supporters += 1
                    hypothesis.supporters += 1
                    supported.append(hypothesis)
        self._hypotheses_from.setdefault(closure.j, []).append(new)
        newly_confirmed = [
            hypothesis
            for hypothesis in (*supported, new)
            if not hypothesis.confirmed and hypothesis.supporters >= self._min_agreeing
        ]
        for hypothesis in newly_confirmed:
            hypothesis.confirmed = True
        return [hypothesis.closure for hypothesis in newly_confirmed]

    def _agree(
        self, other: LoopClosure, new: LoopClosure, near_i: dict[int, NodePath], near_j: dict[int, NodePath]
    ) -> bool:
        """Return whether the other loop, carried over along the path at both its ends, is the new one."""
        if other.i not in near_i or new.T_i_j is None or other.T_i_j is None:
            return False
        T_i_other = inverse(self._estimator.pose_of(new.i)) @ self._estimator.pose_of(other.i)
        T_other_j = inverse(self._estimator.pose_of(other.j)) @ self._estimator.pose_of(new.j)
        carried = T_i_other @ other.T_i_j @ T_other_j
        paths = near_i[other.i], near_j[other.j]
        both = NodePath(sum(path.path_m for path in paths), sum(path.turned_rad for path in paths))
        return not exceeds(pose_difference(new.T_i_j, carried), allowed(self._gate, both))
