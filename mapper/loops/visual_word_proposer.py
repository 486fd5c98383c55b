"""Proposer of images with similar visual words, by a bag of words (Zhao et al. 2020, §1.3)."""

from functools import lru_cache

from mapper.features.frame_view import ImageView
from mapper.loops.base import Proposal, Proposer
from mapper.loops.config import PlaceLoopsConfig
from mapper.loops.nearby_proposer import CombinedProposer, NodePoses, PoseProposer
from mapper.loops.online_pose_estimator import OnlinePoseEstimator
from mapper.places.config import PlacesConfig
from mapper.places.index import PlaceIndex
from mapper.places.vocabulary import WordVector, load_vocabulary

_MIN_DEVIATIONS = 3.0
"""A place of any similarity is proposed that exceeds the median of all by these standard deviations, so that
images with few features are recognised as well."""


class VisualWordProposer:
    """Visual word proposer: similar images at any distance."""

    def __init__(self, config: PlacesConfig) -> None:
        """Load the vocabulary.

        Raises:
            VocabularyError: The vocabulary cannot be read, or is of another kind.
        """
        self._config = config
        self._vocabulary = load_vocabulary(config.path)
        self._index = PlaceIndex(self._vocabulary)
        self._vector = lru_cache(1)(self._vector_of)  # a place is queried and then added

    def propose(self, _node: int, seen: ImageView, /, *, before: int, limit: int) -> list[Proposal]:
        """Return the most similar places, the most similar first."""
        found = self._index.query(
            self._vector(seen),
            min_similarity=self._config.min_similarity,
            min_deviations=_MIN_DEVIATIONS,
            limit=limit,
            before=before,
        )
        return [Proposal(other, "places", similarity) for other, similarity in found]

    def add(self, node: int, seen: ImageView) -> None:
        """Add a place."""
        self._index.add(node, self._vector(seen))

    def _vector_of(self, view: ImageView) -> WordVector:
        return self._vocabulary.vector(self._vocabulary.words_of(view.bits))


def image_proposer(
    config: PlaceLoopsConfig, estimator: OnlinePoseEstimator, first: ImageView
) -> Proposer[ImageView]:
    """Return the proposer that fits a log's first keyframe: only ORB's descriptors have words."""
    by_pose = nearby_images(config, estimator)
    if config.propose == "nearby" or (config.propose == "auto" and not first.is_orb):
        return by_pose
    by_words = VisualWordProposer(config.places)
    return by_words if config.propose == "places" else CombinedProposer(by_words, by_pose)


def nearby_images(config: PlaceLoopsConfig, poses: NodePoses) -> PoseProposer[ImageView]:
    """Return the proposer of images by pose."""
    return PoseProposer(
        poses,
        lambda view: view.T_body_camera,
        max_distance_m=config.max_distance_m,
        max_angle_rad=config.max_angle_rad,
        drift_ratio=config.gate.drift_ratio,
    )
