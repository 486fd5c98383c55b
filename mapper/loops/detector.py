"""Loop detectors: they search loops while a log is tracked, and accept or reject every candidate.

The drift gate rejects loops that odometry and wheels rule out, and reports where many of these agree.
"""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Generic, Protocol

import numpy as np

from mapper.core.errors import ConfigError, FrameError
from mapper.core.geometry import Transform, inverse
from mapper.core.timebase import NS_PER_S
from mapper.features.frame_view import FrameView
from mapper.graph.measurement_covariance import Comparison, compare
from mapper.graph.model import PoseGraph
from mapper.loops.base import Place, Proposer, Verifier, verify_proposal
from mapper.loops.closure import MIN_CONFLICTS, Discrepancy, LoopClosure, exceeds, pose_difference
from mapper.loops.config import GateConfig, KeyframeLoopsConfig
from mapper.loops.consistency_check import ConsistencyCheck
from mapper.loops.nearby_proposer import PoseProposer
from mapper.loops.odometry_drift import OdometryChain, allowed
from mapper.loops.online_pose_estimator import OnlinePoseEstimator
from mapper.loops.place_file import AnyPlace
from mapper.odometry.base import FrameResult
from mapper.runtime.archived import Archived, ArchivedMapping, archived

ViewOf = Callable[[], FrameView]

UNCONFIRMED = ("unconfirmed", "no loop from a keyframe nearby agrees")
"""Step and reason of a measured loop that no other has confirmed yet."""


class LoopDetector(Protocol):
    """Loop detector: takes every new node and keeps the loops found so far."""

    def add(self, node: int, track: FrameResult, view: ViewOf, /) -> None:
        """Search loops from a track that became a node; its view is made only if it is needed."""
        ...

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far, with its verdict as of now."""
        ...

    def current_estimate(self, node: int) -> Transform:
        """Return the (4, 4) current estimate of a node's pose, with the loops so far."""
        ...

    def notes(self) -> Sequence[str]:
        """Return what is suspicious about the loops so far, a sentence each."""
        return ()

    def places(self) -> Mapping[int, AnyPlace]:
        """Return the places that were kept, by node."""
        return {}


class NoLoopDetector(LoopDetector):
    """Loop detector that finds nothing; its estimate is the odometry's."""

    def __init__(self) -> None:
        self._T_world_node: dict[int, Transform] = {}

    def add(self, node: int, track: FrameResult, _view: ViewOf, /) -> None:
        """Keep the odometry's pose of a node."""
        self._T_world_node[node] = track.T_world_body

    def closures(self) -> Sequence[LoopClosure]:
        """Return nothing."""
        return ()

    def current_estimate(self, node: int) -> Transform:
        """Return the odometry's (4, 4) pose of a node."""
        return self._T_world_node[node]


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """Time and odometry pose of a search for loops, and the length of the path over all searches before."""

    stamp_ns: int
    T_world_body: Transform
    path_m: float


class KeyframeLoopDetector(Generic[Place]):
    """Loop detector that compares keyframes with known places.

    A candidate is measured (``Verifier``), its disagreement with the current estimate compared with the drift
    that odometry and wheels may have since (``DriftGate``), and it is a hypothesis until a loop from another
    keyframe nearby agrees (``ConsistencyCheck``).
    """

    def __init__(
        self,
        config: KeyframeLoopsConfig,
        verifier: Verifier[Place],
        proposer_for: Callable[[Place], Proposer[Place]],
        estimator: OnlinePoseEstimator,
        chain: OdometryChain,
    ) -> None:
        """Start without places.

        Args:
            config: Settings.
            verifier: Compares two places.
            proposer_for: Returns the proposer that fits the first keyframe.
            estimator: Empty; poses of the nodes.
            chain: Empty; factors between the nodes.
        """
        self._config = config
        self._estimator = estimator
        self._chain = chain
        self._verifier = verifier
        self._proposer_for = proposer_for
        consistency_check = partial(
            ConsistencyCheck, chain, estimator, config.gate, within_m=config.agreement_path_m
        )
        self._consistency = consistency_check(min_agreeing=config.min_agreeing)
        self._gate = DriftGate(config.gate, chain, estimator, consistency_check(min_agreeing=MIN_CONFLICTS))
        self._proposer: Proposer[Place] | None = None
        self._places: dict[int, Archived[Place]] = {}
        self._preloaded = 0
        self._searches: list[_Search] = []
        self._closures: dict[tuple[int, int], LoopClosure] = {}
        self._disconnected: Set[int] = frozenset()
        self._stamps_ns: dict[int, int] = {}  # of this session's nodes

    def preload(self, graph: PoseGraph, views: Mapping[int, FrameView]) -> None:
        """Add the places of an earlier session, before anything else.

        Their poses relative to this session are unknown until a loop connects the two: until then they are
        proposed by similarity only, and no gate applies.

        Args:
            graph: Solved graph of that session.
            views: Views of its nodes, in time order.

        Raises:
            ConfigError: Places are not recognised by similarity, or the views are of another sensor.
        """
        self._estimator.preload(graph)
        self._chain.add(graph.factors)
        self._disconnected = graph.T_world_node.keys()
        for node, seen in views.items():
            place = self._verifier.describe(seen)
            if isinstance(self._proposer_of(place), PoseProposer):
                raise ConfigError(
                    "places of another session are recognised by visual words alone; "
                    "want loops.propose=auto or places, and an ORB detector"
                )
            self._add_place(node, place)
        self._preloaded = len(self._places)

    def add(self, node: int, track: FrameResult, view: ViewOf, /) -> None:
        """Search loops from a new node, and keep it as a place."""
        self._estimator.add(node, track)
        self._chain.add(track.links)
        self._stamps_ns[node] = track.stamp_ns
        search = self._search_from(track)
        if search is None:
            return
        try:
            place = self._verifier.describe(view())
        except FrameError:
            return  # wheel odometry reads a damaged frame here first; the second pass reports it
        self._searches.append(search)
        proposer, limit = self._proposer_of(place), self._config.max_candidates
        for proposal in proposer.propose(node, place, before=self._old_enough(), limit=limit):
            if proposal.proposed_by == "nearby" and proposal.node in self._disconnected:
                continue
            known = self._places[proposal.node].data
            closure = self._gate.checked(verify_proposal(proposal, node, known, place, self._verifier))
            self._closures[closure.i, closure.j] = closure
            if closure.verdict == "accepted":
                self._add_hypothesis(closure)
                break
        self._add_place(node, place)

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far, with its verdict as of now."""
        return tuple(self._closures.values())

    def current_estimate(self, node: int) -> Transform:
        """Return the (4, 4) current estimate of a node's pose, with the loops so far."""
        return self._estimator.pose_of(node)

    def notes(self) -> Sequence[str]:
        """Return a sentence about loops that agree with each other, but not with odometry or wheels."""
        return self._gate.notes()

    def places(self) -> Mapping[int, Place]:
        """Return the places that were kept, those of an earlier session too, by node."""
        return ArchivedMapping(self._places)

    def _search_from(self, track: FrameResult) -> _Search | None:
        """Return the search to make from here; None where too little has changed since the last."""
        if not track.is_sharp:
            return None
        path_m = 0.0
        if self._searches:
            last = self._searches[-1]
            moved = pose_difference(last.T_world_body, track.T_world_body)
            if not exceeds(moved, Discrepancy(self._config.min_motion_m, self._config.min_motion_rad)):
                return None
            path_m = last.path_m + moved.translation_m
        return _Search(track.stamp_ns, track.T_world_body, path_m)

    def _proposer_of(self, place: Place) -> Proposer[Place]:
        """Return the proposer; the first place decides which."""
        if self._proposer is None:
            self._proposer = self._proposer_for(place)
        return self._proposer

    def _add_place(self, node: int, place: Place) -> None:
        self._proposer_of(place).add(node, place)
        self._places[node] = archived(place)

    def _old_enough(self) -> int:
        """Return how many places may be proposed: all but the latest, which are left to the odometry."""
        now = self._searches[-1]
        max_stamp_ns = now.stamp_ns - round(self._config.min_gap_s * NS_PER_S)
        max_path_m = now.path_m - self._config.min_gap_m
        by_time = bisect_right(self._searches, max_stamp_ns, key=lambda search: search.stamp_ns)
        by_path = bisect_right(self._searches, max_path_m, key=lambda search: search.path_m)
        return self._preloaded + min(by_time, by_path)

    def _add_hypothesis(self, closure: LoopClosure) -> None:
        """Keep a measured loop as a hypothesis, and accept all that are confirmed now."""
        self._closures[closure.i, closure.j] = closure.rejected(*UNCONFIRMED)
        for confirmed in self._consistency.add(closure):
            self._closures[confirmed.i, confirmed.j] = confirmed
            self._estimator.close(confirmed)
            self._chain.add([confirmed.factor])
            if confirmed.i in self._disconnected:
                self._disconnected = frozenset()


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
