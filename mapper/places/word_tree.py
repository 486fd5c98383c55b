"""Search tree of binary cluster centres whose leaves are the visual words."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.features.hamming import Bits
from mapper.places.kernels import descend

Ids = NDArray[np.int32]
"""(N,) int32: words or nodes."""


@dataclass(frozen=True, eq=False)
class WordTree:
    """k-ary tree: nodes level by level from the root, node 0; siblings are adjacent.

    Attributes:
        centres: (T, 4) uint64 centre of every node; the root's is not used.
        children: (T,) uint8 number of children of each node; those without are the words, in this order.
    """

    centres: Bits
    children: NDArray[np.uint8]

    def __post_init__(self) -> None:
        nodes = len(self.children)
        if self.centres.shape != (nodes, 4) or self.centres.dtype != np.uint64:
            raise DataError(
                f"word tree: {nodes} nodes with centres {self.centres.shape} of {self.centres.dtype}, "
                "want (nodes, 4) of uint64"
            )
        known = 1 + np.cumsum(self.children, dtype=np.int64)  # the root and nodes whose parent came before
        if nodes == 0 or known[-1] != nodes or (known[:-1] <= np.arange(1, nodes)).any():
            raise DataError(f"word tree: the child counts of {nodes} nodes do not make one tree")

    @cached_property
    def leaves(self) -> Ids:
        """(W,) node of every word."""
        return np.flatnonzero(self.children == 0).astype(np.int32)

    @cached_property
    def depth(self) -> NDArray[np.int32]:
        """(T,) number of steps from the root to each node."""
        depth = np.zeros(len(self.children), np.int32)
        for node in range(1, len(depth)):
            depth[node] = depth[self._parent[node]] + 1
        return depth

    @cached_property
    def _parent(self) -> Ids:
        nodes = np.arange(len(self.children), dtype=np.int32)
        return np.concatenate([nodes[:1], np.repeat(nodes, self.children)])

    @cached_property
    def _first_child(self) -> Ids:
        counts = self.children.astype(np.int32)
        return (1 + np.cumsum(counts, dtype=np.int32) - counts).astype(np.int32)

    @cached_property
    def _word(self) -> Ids:
        word = np.full(len(self.children), -1, np.int32)
        word[self.leaves] = np.arange(len(self.leaves), dtype=np.int32)
        return word

    def words_of(self, bits: Bits) -> Ids:
        """Return (N,) the word of each of (N, 4) descriptors.

        Raises:
            DataError: The descriptors are not of 256 bits in four words.
        """
        if bits.ndim != 2 or bits.shape[1] != 4 or bits.dtype != np.uint64:
            raise DataError(f"descriptors {bits.shape} of {bits.dtype}, want (N, 4) of uint64: 256 bits each")
        words: Ids = descend(bits, self.centres, self._first_child, self.children, self._word)
        return words

    def ancestors_of(self, words: Ids, *, level: int) -> Ids:
        """Return (N,) the ancestor of each word ``level`` steps below the root; a shallower word itself."""
        return self._ancestors(level)[words]

    def _ancestors(self, level: int) -> Ids:
        node = self.leaves
        while (deeper := self.depth[node] > level).any():
            node = np.where(deeper, self._parent[node], node)
        return node
