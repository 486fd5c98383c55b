"""Finds the places whose images share words with a given one."""

import numpy as np
from numpy.typing import NDArray

from mapper.errors import DataError
from mapper.places.kernels import accumulate, append_postings
from mapper.places.vocabulary import Vocabulary, WordVector

_BLOCK = 32
_FIRST_BLOCKS = 1024


class PlaceIndex:
    """An inverted index: for every word, which nodes have it and how much it weighs in each.

    A query visits only the postings of its own words. Nodes keep the order in which they were added.
    """

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._nodes: list[int] = []
        self._known: set[int] = set()
        self._first = np.full(vocabulary.words, -1, np.int32)
        self._last = np.full(vocabulary.words, -1, np.int32)
        self._following = np.empty(_FIRST_BLOCKS, np.int32)
        self._filled = np.empty(_FIRST_BLOCKS, np.int32)
        self._rows = np.empty((_FIRST_BLOCKS, _BLOCK), np.int32)
        self._weights = np.empty((_FIRST_BLOCKS, _BLOCK), np.float32)
        self._used = 0

    def __len__(self) -> int:
        return len(self._nodes)

    def add(self, node: int, vector: WordVector) -> None:
        """Remember what a node looks like.

        Raises:
            DataError: The node has been added before.
        """
        if node in self._known:
            raise DataError(f"place index: node {node} is in it already")
        self._make_room(len(vector.ids))
        self._used = append_postings(
            vector.ids,
            vector.weights,
            len(self._nodes),
            self._first,
            self._last,
            self._following,
            self._filled,
            self._rows,
            self._weights,
            self._used,
        )
        self._nodes.append(node)
        self._known.add(node)

    def query(
        self, vector: WordVector, *, min_similarity: float, limit: int, before: int | None = None
    ) -> list[tuple[int, float]]:
        """Return the most similar nodes with their similarity, best first; of equals, the earlier.

        Args:
            vector: What is seen now.
            min_similarity: Less is not returned; nor is ever a node that shares no word.
            limit: How many nodes are returned at most.
            before: Only the first so many nodes take part, for the latest look alike anyway; None is all.
        """
        rows = len(self._nodes) if before is None else min(max(before, 0), len(self._nodes))
        similarity: NDArray[np.float64] = accumulate(
            vector.ids,
            vector.weights,
            rows,
            self._first,
            self._following,
            self._filled,
            self._rows,
            self._weights,
        )
        found = np.flatnonzero((similarity >= min_similarity) & (similarity > 0.0))
        best = found[np.argsort(-similarity[found], kind="stable")[:limit]]
        return [(self._nodes[row], float(similarity[row])) for row in best.tolist()]

    def _make_room(self, blocks: int) -> None:
        missing = self._used + blocks - len(self._rows)
        if missing <= 0:
            return
        more = max(missing, len(self._rows))
        self._following = np.concatenate([self._following, np.empty(more, np.int32)])
        self._filled = np.concatenate([self._filled, np.empty(more, np.int32)])
        self._rows = np.concatenate([self._rows, np.empty((more, _BLOCK), np.int32)])
        self._weights = np.concatenate([self._weights, np.empty((more, _BLOCK), np.float32)])
