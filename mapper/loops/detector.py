"""Looks for loops while a log is tracked, and gives every candidate its verdict."""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Generic, Protocol

import numpy as np

from mapper.core.errors import ConfigError, FrameError
from mapper.core.geometry import Transform
from mapper.core.timebase import NS_PER_S
from mapper.graph.model import PoseGraph
from mapper.loops.base import Place, Proposer, Verifier, measured
from mapper.loops.closure import Discrepancy, LoopClosure, discrepancy, exceeds
from mapper.loops.config import KeyframeLoopsConfig
from mapper.loops.consistency_check import ConsistencyCheck
from mapper.loops.odometry_chain import OdometryChain, allowed
from mapper.loops.online_poses import Correction, OnlinePoseEstimator, build_pose_estimator
from mapper.loops.proposals import ByPose
from mapper.odometry.base import FrameResult, Seen

ViewOf = Callable[[], Seen]
ProposerFor = Callable[[Place, OnlinePoseEstimator, OdometryChain], Proposer[Place]]
"""Makes the proposer that fits the first keyframe."""

_ALONE = "alone: no loop found from nearby tells the same"


class LoopDetector(Protocol):
    """Takes every new node in and knows the loops so far."""

    def add(self, node: int, track: FrameResult, view: ViewOf, /) -> None:
        """Look for loops from a track that became a node; its view is made only if it is needed."""
        ...

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far, with its verdict as of now."""
        ...

    def current_estimate(self, node: int) -> Transform:
        """Return where a node is believed to be now (4, 4), with the loops so far."""
        ...


class NoLoopDetector:
    """Looks for nothing, and believes the odometry."""

    def __init__(self) -> None:
        self._T_world_node: dict[int, Transform] = {}

    def add(self, node: int, track: FrameResult, _view: ViewOf, /) -> None:
        """Take the odometry's word."""
        self._T_world_node[node] = track.T_world_body

    def closures(self) -> Sequence[LoopClosure]:
        """Return nothing."""
        return ()

    def current_estimate(self, node: int) -> Transform:
        """Return where the odometry put a node (4, 4)."""
        return self._T_world_node[node]


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """When and where loops were looked for, as the odometry tells; the path is that of the looks before."""

    stamp_ns: int
    T_world_body: Transform
    path_m: float


class KeyframeLoopDetector(Generic[Place]):
    """Compares keyframes with known places; believes what the tests, the gate and another loop confirm.

    A candidate is measured (``Verifier``), held against how far the odometry can have drifted since
    (``OdometryChain``), and kept back until a loop from another keyframe nearby agrees
    (``ConsistencyCheck``).
    """

    def __init__(
        self,
        config: KeyframeLoopsConfig,
        verifier: Verifier[Place],
        proposer_for: ProposerFor[Place],
        *,
        correction: Correction,
    ) -> None:
        self._config = config
        self._estimator = build_pose_estimator(correction)
        self._chain = OdometryChain()
        self._verifier = verifier
        self._proposer_for = proposer_for
        self._consistency = ConsistencyCheck(
            self._chain,
            self._estimator,
            config.gate,
            min_agreeing=config.min_agreeing,
            within_m=config.agreement_path_m,
        )
        self._proposer: Proposer[Place] | None = None
        self._places: dict[int, Place] = {}
        self._known_before = 0
        self._looks: list[_Look] = []
        self._closures: dict[tuple[int, int], LoopClosure] = {}
        self._elsewhere: Set[int] = frozenset()

    def preload(self, graph: PoseGraph, views: Mapping[int, Seen]) -> None:
        """Take in the places of an earlier session, before anything is added.

        Where they lie from here nobody knows until a loop ties the two sessions: until then they are
        proposed by what they look like only, and no gate holds.

        Args:
            graph: Of that session, solved.
            views: Of its nodes, in time order.

        Raises:
            ConfigError: Places are not recognised by what they look like, or another sensor saw them.
        """
        self._estimator.preload(graph)
        self._chain.add(graph.factors)
        self._elsewhere = graph.T_world_node.keys()
        for node, seen in views.items():
            place = self._verifier.describe(seen)
            if isinstance(self._proposer_of(place), ByPose):
                raise ConfigError(
                    "places of another session are recognised by visual words alone; "
                    "want loops.propose=auto or places, and an ORB detector"
                )
            self._remember(node, place)
        self._known_before = len(self._places)

    def add(self, node: int, track: FrameResult, view: ViewOf, /) -> None:
        """Look for loops from a new node, and remember it as a place."""
        self._estimator.add(node, track)
        self._chain.add(track.links)
        look = self._look_from(track)
        if look is None:
            return
        try:
            place = self._verifier.describe(view())
        except FrameError:
            return  # who tracks without looking meets a damaged frame here; the second pass will tell
        self._looks.append(look)
        proposer, limit = self._proposer_of(place), self._config.max_candidates
        for proposal in proposer.propose(node, place, before=self._old_enough(), limit=limit):
            if proposal.proposed_by == "nearby" and proposal.node in self._elsewhere:
                continue
            known = self._places[proposal.node]
            closure = self._judged(measured(proposal, node, known, place, self._verifier))
            self._closures[closure.i, closure.j] = closure
            if closure.verdict == "accepted":
                self._hold_back(closure)
                break
        self._remember(node, place)

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far, with its verdict as of now."""
        return tuple(self._closures.values())

    def current_estimate(self, node: int) -> Transform:
        """Return where a node is believed to be now (4, 4), with the loops so far."""
        return self._estimator.pose_of(node)

    def _look_from(self, track: FrameResult) -> _Look | None:
        """Return the look to be taken from here; None where too little has changed since the last."""
        if not track.is_sharp:
            return None
        path_m = 0.0
        if self._looks:
            last = self._looks[-1]
            moved = discrepancy(np.eye(4), last.T_world_body, track.T_world_body)
            if not exceeds(moved, Discrepancy(self._config.min_motion_m, self._config.min_motion_rad)):
                return None
            path_m = last.path_m + moved.translation_m
        return _Look(track.stamp_ns, track.T_world_body, path_m)

    def _proposer_of(self, place: Place) -> Proposer[Place]:
        """Return the proposer; the first place that is seen decides which."""
        if self._proposer is None:
            self._proposer = self._proposer_for(place, self._estimator, self._chain)
        return self._proposer

    def _remember(self, node: int, place: Place) -> None:
        self._proposer_of(place).add(node, place)
        self._places[node] = place

    def _old_enough(self) -> int:
        """Return how many places may be proposed: all but the latest, which are the odometry's to know."""
        now = self._looks[-1]
        min_gap_ns = round(self._config.min_gap_s * NS_PER_S)
        by_time = bisect_right(self._looks, now.stamp_ns - min_gap_ns, key=lambda look: look.stamp_ns)
        by_path = bisect_right(self._looks, now.path_m - self._config.min_gap_m, key=lambda look: look.path_m)
        return self._known_before + min(by_time, by_path)

    def _judged(self, closure: LoopClosure) -> LoopClosure:
        """Reject a measurement that the odometry cannot have drifted by."""
        path = self._chain.between(closure.i, closure.j)
        if closure.T_i_j is None or path is None:
            return closure
        miss = discrepancy(
            closure.T_i_j, self._estimator.pose_of(closure.i), self._estimator.pose_of(closure.j)
        )
        limit = allowed(self._config.gate, path)
        if not exceeds(miss, limit):
            return closure
        reason = (
            f"gate: {miss.translation_m:.2f} m and {miss.rotation_rad:.2f} rad off, at most "
            f"{limit.translation_m:.2f} m and {limit.rotation_rad:.2f} rad after {path.path_m:.1f} m of path"
        )
        return replace(closure, verdict="rejected", reason=reason)

    def _hold_back(self, closure: LoopClosure) -> None:
        """Keep a measured loop until others agree, and close all that are ripe now."""
        self._closures[closure.i, closure.j] = replace(closure, verdict="rejected", reason=_ALONE)
        for confirmed in self._consistency.add(closure):
            self._closures[confirmed.i, confirmed.j] = confirmed
            self._estimator.close(confirmed)
            self._chain.add([confirmed.factor])
            if confirmed.i in self._elsewhere:
                self._elsewhere = frozenset()
