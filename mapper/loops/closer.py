"""Looks for loops while a log is tracked, and gives every candidate its verdict."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace
from statistics import median
from typing import Protocol

import numpy as np

from mapper.config.loops import PlaceLoopsConfig, ThesisLoopsConfig
from mapper.errors import ConfigError
from mapper.features.view import View
from mapper.geometry import Transform
from mapper.graph.model import PoseGraph
from mapper.loops.agreement import Agreement
from mapper.loops.belief import Correction, belief_for
from mapper.loops.closure import Discrepancy, LoopClosure, discrepancy, exceeds
from mapper.loops.drift import Ways, allowed
from mapper.loops.proposals import ByBoth, ByPose, ByWords, Proposal, Proposer
from mapper.loops.verification import Verifier
from mapper.odometry.base import Track
from mapper.odometry.keyframes import SharpestKeyframes
from mapper.timebase import NS_PER_S

ViewOf = Callable[[], View]

_ALONE = "alone: no loop found from nearby tells the same"


class Closer(Protocol):
    """Takes every new node in and knows the loops so far."""

    def add(self, node: int, track: Track, view: ViewOf, /) -> None:
        """Look for loops from a track that became a node; its view is made only if it is needed."""
        ...

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far, with its verdict as of now."""
        ...

    def believed(self, node: int) -> Transform:
        """Return where a node is believed to be now (4, 4), with the loops so far."""
        ...


class NoLoops:
    """Looks for nothing, and believes the odometry."""

    def __init__(self) -> None:
        self._T_world_node: dict[int, Transform] = {}

    def add(self, node: int, track: Track, _view: ViewOf, /) -> None:
        """Take the odometry's word."""
        self._T_world_node[node] = track.T_world_body

    def closures(self) -> Sequence[LoopClosure]:
        """Return nothing."""
        return ()

    def believed(self, node: int) -> Transform:
        """Return where the odometry put a node (4, 4)."""
        return self._T_world_node[node]


class PlaceLoops:
    """Compares keyframes with known places; believes what two tests, the gate and another loop confirm.

    A candidate is measured (``Verifier``), held against how far the odometry can have drifted since
    (``Ways``), and kept back until a loop from another keyframe nearby agrees (``Agreement``).
    """

    def __init__(self, config: PlaceLoopsConfig, *, correction: Correction) -> None:
        self._config = config
        self._belief = belief_for(correction)
        self._ways = Ways()
        self._verifier = Verifier(config.verification)
        self._agreement = Agreement(
            self._ways,
            self._belief,
            config.gate,
            min_agreeing=config.min_agreeing,
            within_m=config.agreement_path_m,
        )
        self._proposer: Proposer | None = None
        self._views: dict[int, View] = {}
        self._last_looked: Transform | None = None
        self._closures: dict[tuple[int, int], LoopClosure] = {}
        self._elsewhere: Set[int] = frozenset()

    def know(self, graph: PoseGraph, views: Mapping[int, View]) -> None:
        """Take in the places of an earlier session, before anything is added.

        Where they lie from here nobody knows until a loop ties the two sessions: until then they are
        proposed by what they look like only, and no gate holds.

        Args:
            graph: Of that session, solved.
            views: Of its nodes, in time order.

        Raises:
            ConfigError: Places are not recognised by what they look like.
        """
        self._belief.know(graph)
        self._ways.add(graph.factors)
        self._elsewhere = graph.T_world_node.keys()
        min_gap_ns = round(self._config.min_gap_s * NS_PER_S)
        for node, seen in views.items():
            if self._proposer is None:
                self._proposer = self._proposer_for(seen)
            if isinstance(self._proposer, ByPose):
                raise ConfigError(
                    "places of another session are recognised by visual words alone; "
                    "want loops.propose=auto or places, and an ORB detector"
                )
            # What odometry cannot know may be proposed at once, however little time lies between.
            self._proposer.remember(node, replace(seen, stamp_ns=seen.stamp_ns - min_gap_ns))
            self._views[node] = seen

    def add(self, node: int, track: Track, view: ViewOf, /) -> None:
        """Look for loops from a new node, and remember it as a place."""
        self._belief.add(node, track)
        self._ways.add(track.links)
        if not self._has_moved(track.T_world_body):
            return
        seen = view()
        if self._proposer is None:
            self._proposer = self._proposer_for(seen)
        for proposal in self._proposer.propose(node, seen, limit=self._config.max_candidates):
            if proposal.proposed_by == "nearby" and proposal.node in self._elsewhere:
                continue
            closure = self._judged(measured(proposal, node, self._views[proposal.node], seen, self._verifier))
            self._closures[closure.i, closure.j] = closure
            if closure.verdict == "accepted":
                self._hold_back(closure)
                break
        self._proposer.remember(node, seen)
        self._views[node] = seen

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far, with its verdict as of now."""
        return tuple(self._closures.values())

    def believed(self, node: int) -> Transform:
        """Return where a node is believed to be now (4, 4), with the loops so far."""
        return self._belief.pose_of(node)

    def _has_moved(self, T_world_body: Transform) -> bool:
        """Tell whether enough has changed since the last look, and if so, note it."""
        if self._last_looked is not None:
            moved = discrepancy(np.eye(4), self._last_looked, T_world_body)
            if not exceeds(moved, Discrepancy(self._config.min_motion_m, self._config.min_motion_rad)):
                return False
        self._last_looked = T_world_body
        return True

    def _proposer_for(self, view: View) -> Proposer:
        config = self._config
        by_pose = ByPose(
            self._belief,
            max_distance_m=config.max_distance_m,
            max_angle_rad=config.max_angle_rad,
            drift_ratio=config.gate.drift_ratio,
            min_gap_s=config.min_gap_s,
        )
        if config.propose == "nearby" or (config.propose == "auto" and not view.is_orb):
            return by_pose
        by_words = ByWords(config.places, min_gap_s=config.min_gap_s)
        return by_words if config.propose == "places" else ByBoth(by_words, by_pose)

    def _judged(self, closure: LoopClosure) -> LoopClosure:
        """Reject a measurement that the odometry cannot have drifted by."""
        way = self._ways.between(closure.i, closure.j)
        if closure.T_i_j is None or way is None:
            return closure
        miss = discrepancy(closure.T_i_j, self._belief.pose_of(closure.i), self._belief.pose_of(closure.j))
        limit = allowed(self._config.gate, way)
        if not exceeds(miss, limit):
            return closure
        reason = (
            f"gate: {miss.translation_m:.2f} m and {miss.rotation_rad:.2f} rad off, at most "
            f"{limit.translation_m:.2f} m and {limit.rotation_rad:.2f} rad after {way.path_m:.1f} m of path"
        )
        return replace(closure, verdict="rejected", reason=reason)

    def _hold_back(self, closure: LoopClosure) -> None:
        """Keep a measured loop until others agree, and close all that are ripe now."""
        self._closures[closure.i, closure.j] = replace(closure, verdict="rejected", reason=_ALONE)
        for ripe in self._agreement.add(closure):
            self._closures[ripe.i, ripe.j] = ripe
            self._belief.close(ripe)
            self._ways.add([ripe.factor])
            if ripe.i in self._elsewhere:
                self._elsewhere = frozenset()


class ThesisLoops:
    """The thesis's loop closure (Somlyai, §4.1.4): sharp frames against the keyframes near their estimate."""

    def __init__(self, config: ThesisLoopsConfig, *, correction: Correction) -> None:
        self._config = config
        self._belief = belief_for(correction)
        self._verifier = Verifier(config.verification)
        self._proposer = ByPose(
            self._belief,
            max_distance_m=config.max_distance_m,
            max_angle_rad=config.max_angle_rad,
            drift_ratio=0.0,
            min_gap_s=config.min_gap_s,
        )
        self._sharpest = SharpestKeyframes(config.keyframe_interval)
        self._features: deque[int] = deque(maxlen=config.median_frames)
        self._recent: deque[tuple[int, View]] = deque(maxlen=config.keyframe_interval)
        self._views: dict[int, View] = {}
        self._closures: list[LoopClosure] = []

    def add(self, node: int, track: Track, view: ViewOf, /) -> None:
        """Look for a loop if the frame is sharp, and remember the sharpest of every so many."""
        self._belief.add(node, track)
        seen, features = view(), track.diagnostics.features
        self._features.append(features)
        self._recent.append((node, seen))
        if features > self._config.sharp_ratio * median(self._features):
            self._look(node, seen)
        keyframe = self._sharpest.add(node, features)
        for recent, recent_view in self._recent:
            if recent == keyframe:
                self._views[recent] = recent_view
                self._proposer.remember(recent, recent_view)

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far."""
        return tuple(self._closures)

    def believed(self, node: int) -> Transform:
        """Return where a node is believed to be now (4, 4), with the loops so far."""
        return self._belief.pose_of(node)

    def _look(self, node: int, seen: View) -> None:
        for proposal in self._proposer.propose(node, seen, limit=self._config.max_candidates):
            closure = measured(proposal, node, self._views[proposal.node], seen, self._verifier)
            self._closures.append(closure)
            if closure.verdict == "accepted":
                self._belief.close(closure)
                return


def measured(proposal: Proposal, node: int, i: View, j: View, verifier: Verifier) -> LoopClosure:
    """Return what comparing a node's view j with a proposed place's view i came to."""
    found = verifier.verify(i, j)
    return LoopClosure(
        i=proposal.node,
        j=node,
        stamp_i_ns=i.stamp_ns,
        stamp_j_ns=j.stamp_ns,
        proposed_by=proposal.proposed_by,
        verdict="rejected" if found.reason else "accepted",
        reason=found.reason,
        similarity=proposal.similarity,
        matches=found.matches,
        inliers=found.inliers,
        rmse_m=found.rmse_m,
        residual_px=found.residual_px,
        T_i_j=found.T_i_j,
        information=found.information,
    )
