"""Loop detector against a finished map: a new log's keyframes compared with places that do not move."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, assert_never

import numpy as np

from mapper.core.errors import FrameError
from mapper.core.geometry import Transform
from mapper.graph.model import PoseGraph
from mapper.loops.base import Place, Proposal, Proposer, Verifier, verify_proposal
from mapper.loops.closure import LoopClosure, has_moved
from mapper.loops.config import PlaceLoopsConfig, ScanLoopsConfig
from mapper.loops.consistency_check import ConsistencyCheck
from mapper.loops.detector import UNCONFIRMED, LoopDetector, ViewOf
from mapper.loops.factory import build_similarity_proposer, build_verifier
from mapper.loops.nearby_proposer import NodePoses, PoseProposer
from mapper.loops.odometry_drift import OdometryChain
from mapper.loops.online_pose_estimator import IncrementalPoseEstimator, OnlinePoseEstimator
from mapper.loops.scan_context_proposer import MAX_SIMILAR
from mapper.odometry.base import FrameResult

_MAX_FAILED = 2
"""Searches in a row that fail next to the estimate before the whole map is searched."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownPlaces(Generic[Place]):
    """Places of a finished map, at poses that are not changed.

    Attributes:
        places: Views of its keyframes, by node.
        T_map_node: (4, 4) poses of these nodes.
    """

    places: Mapping[int, Place]
    T_map_node: Mapping[int, Transform]

    @property
    def map_node(self) -> int:
        """Number of the node that stands for the map's frame: all of the map's own come before it."""
        return 1 + max(self.places)


class _InMap:
    """Poses of the known places beside the estimates of the new nodes; see ``NodePoses``."""

    def __init__(self, known: KnownPlaces[Any], estimator: OnlinePoseEstimator) -> None:
        self._known = known
        self._estimator = estimator

    @property
    def corrections(self) -> int:
        """Number of times that the poses of new nodes have changed; known ones do not move."""
        return self._estimator.corrections

    def pose_of(self, node: int) -> Transform:
        """Return the (4, 4) pose of a known place, or the current estimate of a new node's."""
        T_map_node = self._known.T_map_node.get(node)
        return self._estimator.pose_of(node) if T_map_node is None else T_map_node


class MapConstraintDetector(LoopDetector, Generic[Place]):
    """Loop detector that compares the keyframes of a new log with the known places of a map; it keeps none.

    What is measured against a place at a fixed pose is a pose in the map. So every constraint leads from one
    node, that of the map's frame, and the consistency check compares constraints found at any two places.

    Until a part of the path is localised, and when the places next to the current estimate are not recognised
    several times in a row, keyframes are compared with similar places anywhere in the map; else with those
    next to the estimate. No drift gate holds: constraints that contradict the odometry may show that the
    sensor was carried elsewhere.
    """

    def __init__(
        self,
        config: PlaceLoopsConfig | ScanLoopsConfig,
        known: KnownPlaces[Place],
        verifier: Verifier[Place],
        similar: Proposer[Place],
        nearby_for: Callable[[NodePoses], PoseProposer[Place]],
    ) -> None:
        """Add all known places.

        Args:
            config: Settings.
            known: Places of the finished map.
            verifier: Compares two places.
            similar: Empty; proposes similar places.
            nearby_for: Returns an empty proposer of the places near an estimate.
        """
        self._config = config
        self._known = known
        self._verifier = verifier
        self._similar = similar
        self._map = known.map_node
        self._estimator = IncrementalPoseEstimator()
        self._estimator.preload(PoseGraph({self._map: np.eye(4)}, {self._map: 0}))
        self._nearby = nearby_for(_InMap(known, self._estimator))
        for node, place in known.places.items():
            self._similar.add(node, place)
            self._nearby.add(node, place)
        self._chain = OdometryChain()
        self._consistency = ConsistencyCheck(
            self._chain,
            self._estimator,
            config.gate,
            min_agreeing=max(config.min_agreeing, 1),
            within_m=config.agreement_path_m,
        )
        self._localised: list[int] = []
        self._last: Transform | None = None
        self._failed = 0
        self._place_of: dict[int, int] = {}
        self._closures: dict[tuple[int, int], LoopClosure] = {}

    def add(self, node: int, track: FrameResult, view: ViewOf, /) -> None:
        """Search the map from a new node."""
        self._estimator.add(node, track)
        self._chain.add(track.links)
        is_localised = bool(self._localised) and bool(self._chain.connected(node, self._localised).any())
        if not track.is_sharp or (is_localised and not self._has_moved(track)):
            return
        try:
            place = self._verifier.describe(view())
        except FrameError:
            return  # a damaged frame that wheel odometry did not read
        self._last = track.T_world_body
        is_near = is_localised and self._failed < _MAX_FAILED
        self._failed += 1
        for proposal in self._proposals(node, place, is_near=is_near):
            measured = verify_proposal(
                proposal, node, self._known.places[proposal.node], place, self._verifier
            )
            closure = self._in_map(measured)
            self._closures[proposal.node, node] = closure
            if closure.verdict == "accepted":
                self._add_hypothesis(proposal.node, closure)
                break

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far; i is the node of the map's frame, ``stamp_i_ns`` names the place."""
        return tuple(self._closures.values())

    def current_estimate(self, node: int) -> Transform:
        """Return the (4, 4) current estimate of a node's pose, in the map once its part is localised."""
        return self._estimator.pose_of(node)

    def _has_moved(self, track: FrameResult) -> bool:
        return self._last is None or has_moved(self._last, track.T_world_body, self._config)

    def _proposals(self, node: int, place: Place, *, is_near: bool) -> list[Proposal]:
        proposer = self._nearby if is_near else self._similar
        return proposer.propose(
            node, place, before=len(self._known.places), limit=self._config.max_candidates
        )

    def _in_map(self, measured: LoopClosure) -> LoopClosure:
        """Return the closure with the map's frame instead of the place's."""
        T_map_j = None if measured.T_i_j is None else self._known.T_map_node[measured.i] @ measured.T_i_j
        return replace(measured, i=self._map, T_i_j=T_map_j)

    def _add_hypothesis(self, place: int, closure: LoopClosure) -> None:
        """Keep a measured constraint as a hypothesis, and accept all that are confirmed now."""
        self._closures[place, closure.j] = closure.rejected(*UNCONFIRMED)
        self._place_of[closure.j] = place
        for confirmed in self._consistency.add(closure):
            self._failed = 0
            self._closures[self._place_of[confirmed.j], confirmed.j] = confirmed
            self._estimator.close(confirmed)
            self._localised.append(confirmed.j)


def build_map_constraint_detector(
    config: PlaceLoopsConfig | ScanLoopsConfig, known: KnownPlaces[Any]
) -> MapConstraintDetector[Any]:
    """Return the detector that compares a new log with a map.

    Raises:
        ConfigError: The places cannot be recognised by similarity.
    """
    verifier = build_verifier(config.verification)
    first = next(iter(known.places.values()))
    similar = build_similarity_proposer(config, first, most=MAX_SIMILAR)
    match config:
        case PlaceLoopsConfig():
            from mapper.loops.visual_word_proposer import nearby_images

            return MapConstraintDetector(config, known, verifier, similar, partial(nearby_images, config))
        case ScanLoopsConfig():
            from mapper.loops.scan_context_proposer import nearby_scans

            return MapConstraintDetector(config, known, verifier, similar, partial(nearby_scans, config))
        case _:
            assert_never(config)
