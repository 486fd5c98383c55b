"""Which known places a view might show: by a bag of words, or by where it is believed to be."""

from bisect import bisect_right
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mapper.config.places import PlacesConfig
from mapper.features.view import View
from mapper.geometry import Transform
from mapper.loops.belief import Belief
from mapper.loops.closure import ProposedBy
from mapper.places.index import PlaceIndex
from mapper.places.vocabulary import WordVector, load_vocabulary
from mapper.timebase import NS_PER_S


@dataclass(frozen=True, slots=True)
class Proposal:
    """A known place that a view might show.

    Attributes:
        node: The place's node.
        proposed_by: Who thought of it.
        similarity: Of the two images' words (eq. 10), if they were compared.
    """

    node: int
    proposed_by: ProposedBy
    similarity: float | None = None


class Proposer(Protocol):
    """Remembers places, and proposes those that a view might show."""

    def propose(self, node: int, view: View, /, *, limit: int) -> list[Proposal]:
        """Return the likeliest places for a node's view, the likeliest first."""
        ...

    def remember(self, node: int, view: View) -> None:
        """Take a place in; nodes come in time order."""
        ...


class ByWords:
    """Proposes what looks alike (Zhao et al. 2020, §2.5), wherever it is believed to be."""

    def __init__(self, config: PlacesConfig, *, min_gap_s: float) -> None:
        """Load the vocabulary; what was seen within the last ``min_gap_s`` will not be proposed.

        Raises:
            VocabularyError: The vocabulary cannot be read, or is of another kind.
        """
        self._config = config
        self._min_gap_ns = round(min_gap_s * NS_PER_S)
        self._vocabulary = load_vocabulary(config.path)
        self._index = PlaceIndex(self._vocabulary)
        self._stamps_ns: list[int] = []
        self._described: tuple[View, WordVector] | None = None

    def propose(self, _node: int, view: View, /, *, limit: int) -> list[Proposal]:
        """Return the most similar places, the most similar first."""
        found = self._index.query(
            self._vector(view),
            min_similarity=self._config.min_similarity,
            min_deviations=self._config.min_deviations,
            limit=limit,
            before=bisect_right(self._stamps_ns, view.stamp_ns - self._min_gap_ns),
        )
        return [Proposal(other, "places", similarity) for other, similarity in found]

    def remember(self, node: int, view: View) -> None:
        """Take a place in."""
        self._index.add(node, self._vector(view))
        self._stamps_ns.append(view.stamp_ns)

    def _vector(self, view: View) -> WordVector:
        """Return the view's words; the last view's are kept, for who is compared is then remembered."""
        if self._described is None or self._described[0] is not view:
            self._described = view, self._vocabulary.vector(self._vocabulary.words_of(view.bits))
        return self._described[1]


class ByPose:
    """Proposes what was seen from nearby, looking nearly the same way, as far as is believed (A9)."""

    def __init__(
        self,
        belief: Belief,
        *,
        max_distance_m: float,
        max_angle_rad: float,
        drift_ratio: float,
        min_gap_s: float,
    ) -> None:
        """Start without places.

        Args:
            belief: Where the nodes are.
            max_distance_m: Largest distance between two positions.
            max_angle_rad: Largest angle between two viewing directions.
            drift_ratio: How much farther to look per metre travelled since.
            min_gap_s: What was seen more recently is not proposed.
        """
        self._belief = belief
        self._max_distance_m = max_distance_m
        self._max_angle_rad = max_angle_rad
        self._drift_ratio = drift_ratio
        self._min_gap_ns = round(min_gap_s * NS_PER_S)
        self._nodes: list[int] = []
        self._T_body_camera: list[Transform] = []
        self._stamps_ns: list[int] = []
        self._travelled_m: list[float] = []

    def propose(self, node: int, view: View, /, *, limit: int) -> list[Proposal]:
        """Return the nearest places, the nearest first: metres and radians count alike."""
        old = bisect_right(self._stamps_ns, view.stamp_ns - self._min_gap_ns)
        if old == 0:
            return []
        T_world_here = self._belief.pose_of(node) @ view.T_body_camera
        T_world_body = np.array([self._belief.pose_of(place) for place in self._nodes[:old]])
        T_world_place = T_world_body @ np.array(self._T_body_camera[:old])
        distance_m = np.linalg.norm(T_world_place[:, :3, 3] - T_world_here[:3, 3], axis=1)
        since_m = self._travelled_m[-1] - np.array(self._travelled_m[:old])
        near = distance_m <= self._max_distance_m + self._drift_ratio * since_m
        angle_rad = np.arccos(np.clip(T_world_place[:, :3, 2] @ T_world_here[:3, 2], -1.0, 1.0))
        candidates = np.flatnonzero(near & (angle_rad <= self._max_angle_rad))
        apart = distance_m[candidates] + angle_rad[candidates]
        nearest = candidates[np.argsort(apart, kind="stable")[:limit]]
        return [Proposal(self._nodes[k], "nearby") for k in nearest.tolist()]

    def remember(self, node: int, view: View) -> None:
        """Take a place in."""
        travelled_m = 0.0
        if self._nodes:
            step = self._belief.pose_of(node)[:3, 3] - self._belief.pose_of(self._nodes[-1])[:3, 3]
            travelled_m = self._travelled_m[-1] + float(np.linalg.norm(step))
        self._nodes.append(node)
        self._T_body_camera.append(view.T_body_camera)
        self._stamps_ns.append(view.stamp_ns)
        self._travelled_m.append(travelled_m)


class ByBoth:
    """Proposes by words and, where those leave room, by pose."""

    def __init__(self, words: ByWords, pose: ByPose) -> None:
        self._proposers = (words, pose)

    def propose(self, node: int, view: View, /, *, limit: int) -> list[Proposal]:
        """Return what looks alike, then what is believed to be near."""
        proposals: dict[int, Proposal] = {}
        for proposer in self._proposers:
            for proposal in proposer.propose(node, view, limit=limit):
                proposals.setdefault(proposal.node, proposal)
        return list(proposals.values())[:limit]

    def remember(self, node: int, view: View) -> None:
        """Take a place in."""
        for proposer in self._proposers:
            proposer.remember(node, view)
