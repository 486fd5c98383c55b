"""Matching of descriptors under the same node of the vocabulary (Zhao et al. 2020, §1.1)."""

import numpy as np
from numpy.typing import NDArray

from mapper.features.hamming import Bits
from mapper.places.kernels import match_sorted
from mapper.places.word_tree import Ids


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
