"""Finds the places whose images share words with a given one."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.places.kernels import shared_weights
from mapper.places.vocabulary import ONE, Vocabulary, WordVector

_FIRST_CAPACITY = 256
_ENOUGH_TO_COMPARE = 30
_SIGMA_PER_MAD = 1.4826


class PlaceIndex:
    """An inverted index: for every word, how much it weighs in each node, in the order they were added.

    A query visits its own words only. With each it also visits the nodes that do not have it, for that is
    faster than skipping them: of 2200 words an image has every third, and lists of postings took six times as
    long. Two bytes per word and node are kept.
    """

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._nodes: list[int] = []
        self._known: set[int] = set()
        self._weights = np.zeros((vocabulary.words, _FIRST_CAPACITY), np.uint16)

    def __len__(self) -> int:
        return len(self._nodes)

    def add(self, node: int, vector: WordVector) -> None:
        """Remember what a node looks like.

        Raises:
            DataError: The node has been added before, or the vector is of a larger vocabulary.
        """
        if node in self._known:
            raise DataError(f"place index: node {node} is in it already")
        self._refuse_foreign(vector)
        if len(self._nodes) == self._weights.shape[1]:
            self._weights = np.hstack([self._weights, np.zeros_like(self._weights)])
        self._weights[vector.ids, len(self._nodes)] = vector.weights
        self._nodes.append(node)
        self._known.add(node)

    def query(
        self,
        vector: WordVector,
        *,
        min_similarity: float,
        limit: int,
        before: int | None = None,
        min_deviations: float = np.inf,
    ) -> list[tuple[int, float]]:
        """Return the most similar nodes with their similarity, best first; of equals, the earlier.

        Args:
            vector: What is seen now.
            min_similarity: Less is not returned, unless it stands out; nor ever a node that shares no word.
            limit: How many nodes are returned at most.
            before: Only the first so many nodes take part, for the latest look alike anyway; None is all.
            min_deviations: A node stands out when it is this many standard deviations more similar than the
                median node. Both are told robustly, so a few true revisits do not hide each other.

        Raises:
            DataError: The vector is of a larger vocabulary.
        """
        self._refuse_foreign(vector)
        rows = len(self._nodes) if before is None else min(max(before, 0), len(self._nodes))
        shared: NDArray[np.uint16] = shared_weights(vector.ids, vector.weights, self._weights, rows)
        similarity = shared / ONE
        least = min(min_similarity, _outstanding(similarity, min_deviations))
        found = np.flatnonzero((similarity >= least) & (similarity > 0.0))
        best = found[np.argsort(-similarity[found], kind="stable")[:limit]]
        return [(self._nodes[row], float(similarity[row])) for row in best.tolist()]

    def _refuse_foreign(self, vector: WordVector) -> None:
        words = len(self._weights)
        if len(vector.ids) and vector.ids[-1] >= words:
            raise DataError(f"place index: word {vector.ids[-1]} of another vocabulary; this one has {words}")


def _outstanding(similarity: NDArray[np.float64], deviations: float) -> float:
    """Return from which similarity on a node stands out; never where there are few to stand out from."""
    if len(similarity) < _ENOUGH_TO_COMPARE or not np.isfinite(deviations):
        return np.inf
    median = float(np.median(similarity))
    return median + deviations * _SIGMA_PER_MAD * float(np.median(np.abs(similarity - median)))
