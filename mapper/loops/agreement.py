"""Temporal consistency: a loop is believed once loops found from other keyframes nearby tell the same."""

from dataclasses import dataclass

import numpy as np

from mapper.config.loops import GateConfig
from mapper.geometry import inverse
from mapper.loops.belief import Belief
from mapper.loops.closure import LoopClosure, discrepancy, exceeds
from mapper.loops.drift import Way, Ways, allowed


@dataclass(slots=True)
class _Claim:
    """A measured loop and how many others agree with it so far."""

    closure: LoopClosure
    supporters: int = 0
    believed: bool = False


class Agreement:
    """Holds measured loops back until enough others agree."""

    def __init__(
        self, ways: Ways, belief: Belief, gate: GateConfig, *, min_agreeing: int, within_m: float
    ) -> None:
        """Start without loops.

        Args:
            ways: Which nodes are tied to which.
            belief: Where the nodes are.
            gate: What the odometry may drift between neighbours.
            min_agreeing: How many others must agree.
            within_m: How far along the path the ends of two loops may lie to tell of one another.
        """
        self._ways = ways
        self._belief = belief
        self._gate = gate
        self._min_agreeing = min_agreeing
        self._within_m = within_m
        self._claims_from: dict[int, list[_Claim]] = {}

    def add(self, closure: LoopClosure) -> list[LoopClosure]:
        """Take a measured loop in; return all that are to be believed now and were not before."""
        new = _Claim(closure)
        near_i = self._ways.around(closure.i, within_m=self._within_m)
        near_j = self._ways.around(closure.j, within_m=self._within_m)
        helped = []
        for j in sorted(near_j.keys() - {closure.j}):
            for claim in self._claims_from.get(j, ()):
                if claim.believed and new.supporters >= self._min_agreeing:
                    continue  # neither of the two needs the other
                if self._agree(claim.closure, closure, near_i, near_j):
                    new.supporters += 1
                    claim.supporters += 1
                    helped.append(claim)
        self._claims_from.setdefault(closure.j, []).append(new)
        ripe = [
            claim for claim in (*helped, new) if not claim.believed and claim.supporters >= self._min_agreeing
        ]
        for claim in ripe:
            claim.believed = True
        return [claim.closure for claim in ripe]

    def _agree(
        self, other: LoopClosure, new: LoopClosure, near_i: dict[int, Way], near_j: dict[int, Way]
    ) -> bool:
        """Tell whether the other loop, carried over along the path at both its ends, is the new one."""
        if other.i not in near_i or new.T_i_j is None or other.T_i_j is None:
            return False
        T_i_other = inverse(self._belief.pose_of(new.i)) @ self._belief.pose_of(other.i)
        T_other_j = inverse(self._belief.pose_of(other.j)) @ self._belief.pose_of(new.j)
        carried = T_i_other @ other.T_i_j @ T_other_j
        ways = near_i[other.i], near_j[other.j]
        both = Way(sum(way.path_m for way in ways), sum(way.turned_rad for way in ways))
        return not exceeds(discrepancy(new.T_i_j, np.eye(4), carried), allowed(self._gate, both))
