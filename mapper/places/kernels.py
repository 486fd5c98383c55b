"""Compiled loops over binary descriptors and visual words."""

import numpy as np
from numba import njit

from mapper.features.hamming import ORB_BITS, drop_one_sided, hamming, nearest_among

_FARTHER = ORB_BITS + 1


@njit(cache=True, nogil=True)
def descend(bits, centres, first_child, children, word):
    """Return (N,) int32, the word of each descriptor, by descent to the nearest child, the first of equals.

    Args:
        bits: (N, 4) uint64 descriptors.
        centres: (T, 4) uint64 centre of every node; node 0 is the root.
        first_child: (T,) int32.
        children: (T,) uint8 number of children of each node; they are adjacent.
        word: (T,) int32 word of every leaf.
    """
    words = np.empty(len(bits), np.int32)
    for i in range(len(bits)):
        node = 0
        while children[node] > 0:
            nearest, best = -1, _FARTHER
            for child in range(first_child[node], first_child[node] + children[node]):
                distance = hamming(bits, i, centres, child)
                if distance < best:
                    nearest, best = child, distance
            node = nearest
        words[i] = word[node]
    return words


@njit(cache=True, nogil=True)
def seed_centres(bits, draws):
    """Return up to len(draws) rows of bits spread by k-means++ (Arthur & Vassilvitskii 2007).

    Each next centre is drawn with a probability proportional to the squared Euclidean distance to the nearest
    centre so far, which for bits is the Hamming distance. Fewer distinct rows give fewer centres.

    Args:
        bits: (N, 4) uint64 descriptors, N ≥ 1.
        draws: (k,) float64 uniform in [0, 1).
    """
    centres = np.empty((len(draws), 4), np.uint64)
    distance = np.full(len(bits), _FARTHER, np.int64)
    chosen = int(draws[0] * len(bits))
    for c in range(len(draws)):
        centres[c] = bits[chosen]
        total = 0
        for i in range(len(bits)):
            distance[i] = min(distance[i], hamming(bits, i, centres, c))
            total += distance[i]
        if total == 0:
            return centres[: c + 1]
        if c + 1 < len(draws):
            left = int(draws[c + 1] * total)
            chosen = 0
            while left >= distance[chosen]:
                left -= distance[chosen]
                chosen += 1
    return centres


@njit(cache=True, nogil=True)
def k_majority(bits, seeds, max_iterations):
    """Return the centres (k, 4) of Lloyd's iteration on bits, and the cluster (N,) int32 of each row.

    Each bit of a centre becomes that of most of its rows, and is kept at a tie (Grana et al. 2013), so that
    the summed distance never grows. A centre may end without rows.

    Args:
        bits: (N, 4) uint64 descriptors.
        seeds: (k, 4) uint64 centres to start from.
        max_iterations: Largest number of iterations.
    """
    centres = seeds.copy()
    cluster = np.full(len(bits), -1, np.int32)
    one = np.uint64(1)
    for _ in range(max_iterations):
        changed = False
        for i in range(len(bits)):
            nearest, best = -1, _FARTHER
            for c in range(len(centres)):
                distance = hamming(bits, i, centres, c)
                if distance < best:
                    nearest, best = c, distance
            if nearest != cluster[i]:
                cluster[i] = nearest
                changed = True
        if not changed:
            break
        excess = np.zeros((len(centres), ORB_BITS), np.int64)  # rows with the bit less rows without
        for i in range(len(bits)):
            for bit in range(ORB_BITS):
                is_set = (bits[i, bit >> 6] >> np.uint64(bit & 63)) & one
                excess[cluster[i], bit] += 2 * np.int64(is_set) - 1
        for c in range(len(centres)):
            for bit in range(ORB_BITS):
                mask = one << np.uint64(bit & 63)
                if excess[c, bit] > 0:
                    centres[c, bit >> 6] |= mask
                elif excess[c, bit] < 0:
                    centres[c, bit >> 6] &= ~mask
    return centres, cluster


@njit(cache=True, nogil=True)
def shared_weights(ids, weights, weights_of_word, count):
    """Return (count,) uint16: Σ min(fA, fB) over the words of a vector and each of the first of an index.

    That is ½ Σ (|fA| + |fB| − |fA − fB|) (Zhao et al. 2020, eq. 10) of weights that are not negative.

    Args:
        ids: (M,) int32 words of the vector.
        weights: (M,) uint16.
        weights_of_word: (W, R) uint16 weight of every word in every vector.
        count: Number of vectors to compare.
    """
    totals = np.zeros(count, np.uint16)
    for m in range(len(ids)):
        weight, others = weights[m], weights_of_word[ids[m]]
        for i in range(count):  # without a branch, which compiles to vector instructions
            totals[i] += min(weight, others[i])
    return totals


@njit(cache=True, nogil=True)
def match_sorted(bits_a, nodes_a, bits_b, nodes_b, max_hamming, max_ratio):
    """Return (Na,) int32, per row of a its mutually nearest row of b under the same node, or −1.

    Args:
        bits_a: (Na, 4) uint64 descriptors, sorted by node.
        nodes_a: (Na,) int32 ascending.
        bits_b: (Nb, 4) uint64 descriptors, sorted by node.
        nodes_b: (Nb,) int32 ascending.
        max_hamming: Largest distance in bits.
        max_ratio: Largest ratio of best to second-best distance.
    """
    matched = np.full(len(nodes_a), -1, np.int32)
    owner = np.full(len(nodes_b), -1, np.int32)
    best_of_b = np.full(len(nodes_b), _FARTHER, np.int32)
    start = 0
    for i in range(len(nodes_a)):
        while start < len(nodes_b) and nodes_b[start] < nodes_a[i]:
            start += 1
        end = start
        while end < len(nodes_b) and nodes_b[end] == nodes_a[i]:
            end += 1
        best, second, best_j = nearest_among(bits_a, i, bits_b, start, end, best_of_b, owner)
        if best <= max_hamming and best <= max_ratio * second:
            matched[i] = best_j
    drop_one_sided(matched, owner)
    return matched
