"""Which known images look like one: by a bag of words, and by where they are believed to be."""

from mapper.features.view import View
from mapper.loops.base import Proposal, Proposer
from mapper.loops.config import PlaceLoopsConfig
from mapper.loops.odometry_chain import OdometryChain
from mapper.loops.online_poses import OnlinePoseEstimator
from mapper.loops.proposals import ByBoth, ByPose
from mapper.places.config import PlacesConfig
from mapper.places.index import PlaceIndex
from mapper.places.vocabulary import WordVector, load_vocabulary


class ByWords:
    """Proposes what looks alike (Zhao et al. 2020, §2.5), wherever it is believed to be."""

    def __init__(self, config: PlacesConfig) -> None:
        """Load the vocabulary.

        Raises:
            VocabularyError: The vocabulary cannot be read, or is of another kind.
        """
        self._config = config
        self._vocabulary = load_vocabulary(config.path)
        self._index = PlaceIndex(self._vocabulary)
        self._described: tuple[View, WordVector] | None = None

    def propose(self, _node: int, seen: View, /, *, before: int, limit: int) -> list[Proposal]:
        """Return the most similar places, the most similar first."""
        found = self._index.query(
            self._vector(seen),
            min_similarity=self._config.min_similarity,
            min_deviations=self._config.min_deviations,
            limit=limit,
            before=before,
        )
        return [Proposal(other, "places", similarity) for other, similarity in found]

    def add(self, node: int, seen: View) -> None:
        """Take a place in."""
        self._index.add(node, self._vector(seen))

    def _vector(self, view: View) -> WordVector:
        """Return the view's words; the last view's are kept, for who is compared is then remembered."""
        if self._described is None or self._described[0] is not view:
            self._described = view, self._vocabulary.vector(self._vocabulary.words_of(view.bits))
        return self._described[1]


def image_proposer(
    config: PlaceLoopsConfig, first: View, estimator: OnlinePoseEstimator, _chain: OdometryChain, /
) -> Proposer[View]:
    """Return the proposer of a log whose first keyframe looks so: only ORB's descriptors have words."""
    by_pose: ByPose[View] = ByPose(
        estimator,
        lambda view: view.T_body_camera,
        max_distance_m=config.max_distance_m,
        max_angle_rad=config.max_angle_rad,
        drift_ratio=config.gate.drift_ratio,
    )
    if config.propose == "nearby" or (config.propose == "auto" and not first.is_orb):
        return by_pose
    by_words = ByWords(config.places)
    return by_words if config.propose == "places" else ByBoth(by_words, by_pose)
