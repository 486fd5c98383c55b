"""Inverted index of places by the visual words of their images."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.running_median import SIGMAS_PER_MAD
from mapper.features.hamming import Bits
from mapper.places.kernels import match_sorted, shared_weights
from mapper.places.vocabulary import ONE, Ids, Vocabulary, WordVector

_ENOUGH_TO_COMPARE = 30


class PlaceIndex:
    """Inverted index: the weight of every word in each node, in the order in which the nodes were added.

    A query visits its own words only, but all nodes of each: of 2200 words an image has every third, so that
    lists of postings, which skip nodes, took six times as long. It takes two bytes per word and node.
    """

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._nodes: list[int] = []
        self._known: set[int] = set()
        self._weights = np.zeros((vocabulary.words, 1), np.uint16)

    def __len__(self) -> int:
        return len(self._nodes)

    def add(self, node: int, vector: WordVector) -> None:
        """Add a node.

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
            vector: Words of the image to recognise.
            min_similarity: Nodes of less similarity are returned only if they are outstanding; those that
                share no word never are.
            limit: Largest number of nodes to return.
            before: Number of nodes, from the first, that are compared; the latest are similar in any case.
                None is all.
            min_deviations: A node is outstanding if its similarity exceeds the median by this many standard
                deviations, estimated robustly so that a few true revisits do not hide each other.

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
    """Return the similarity from which on a node is outstanding; infinite among few nodes."""
    if len(similarity) < _ENOUGH_TO_COMPARE or not np.isfinite(deviations):
        return np.inf
    median = float(np.median(similarity))
    return median + deviations * SIGMAS_PER_MAD * float(np.median(np.abs(similarity - median)))


def match_by_word(
    bits_a: Bits, nodes_a: Ids, bits_b: Bits, nodes_b: Ids, *, max_hamming: int, max_ratio: float
) -> NDArray[np.int32]:
    """Return (Na,) int32, per row of a its mutually nearest row of b under the same node, or −1.

    Args:
        bits_a: (Na, 4) uint64 descriptors.
        nodes_a: (Na,) their nodes; see ``Vocabulary.ancestors_of``.
        bits_b: (Nb, 4) uint64 descriptors.
        nodes_b: (Nb,) their nodes, on the same level.
        max_hamming: Largest distance in bits.
        max_ratio: Largest ratio of best to second-best distance under the node (Lowe 2004).
    """
    order_a, order_b = np.argsort(nodes_a, kind="stable"), np.argsort(nodes_b, kind="stable")
    matched: NDArray[np.int32] = match_sorted(
        bits_a[order_a], nodes_a[order_a], bits_b[order_b], nodes_b[order_b], max_hamming, max_ratio
    )
    row_of_b = np.full(len(nodes_a), -1, np.int32)
    row_of_b[order_a] = np.where(matched >= 0, order_b[matched] if len(order_b) else -1, -1)
    return row_of_b
