"""256-bit binary descriptors: packing, compiled Hamming distances, and mutual nearest matches."""

import numpy as np
from numba import njit
from numba.extending import intrinsic
from numpy.typing import NDArray

Bits = NDArray[np.uint64]
"""(N, 4) uint64: one 256-bit descriptor per row."""


@intrinsic
def popcount(_context, x):
    """Count the set bits of a uint64 with the processor's own instruction, which numba does not expose."""

    def generate(_typing, builder, _signature, arguments):
        return builder.ctpop(arguments[0])

    return x(x), generate


def pack(descriptors: NDArray[np.uint8] | NDArray[np.float32]) -> Bits:
    """Return (N, 32) uint8 binary descriptors as (N, 4) uint64."""
    return np.ascontiguousarray(descriptors).view(np.uint64).reshape(-1, 4)


@njit(cache=True, nogil=True)
def hamming(a, i, b, j):
    """Return how many of the 256 bits of row i of a and row j of b differ."""
    return np.int64(
        popcount(a[i, 0] ^ b[j, 0])
        + popcount(a[i, 1] ^ b[j, 1])
        + popcount(a[i, 2] ^ b[j, 2])
        + popcount(a[i, 3] ^ b[j, 3])
    )


@njit(cache=True, nogil=True)
def nearest_among(a, i, b, first, end, best_of_b, owner):
    """Return the two smallest distances from row i of a to rows of b, and the nearest of these rows.

    Args:
        a: (M, 4) uint64 descriptors.
        i: Row of a.
        b: (N, 4) uint64 descriptors.
        first: First row of b to compare.
        end: The row after the last.
        best_of_b: (N,) int32 smallest distance of each row of b so far; updated in place.
        owner: (N,) int32 row of a at that distance; updated in place.
    """
    best, second, best_j = 257, 257, -1
    for j in range(first, end):
        d = hamming(a, i, b, j)
        if d < best_of_b[j]:
            best_of_b[j] = d
            owner[j] = i
        if d < best:
            second, best, best_j = best, d, j
        elif d < second:
            second = d
    return best, second, best_j


@njit(cache=True, nogil=True)
def drop_one_sided(matched, owner):
    """Undo the matches (M,) whose partner is nearer to another row, its ``owner`` (N,)."""
    for i in range(len(matched)):
        if matched[i] >= 0 and owner[matched[i]] != i:
            matched[i] = -1


@njit(cache=True, nogil=True)
def match_mutual_bits(a, b, max_hamming, max_ratio):
    """Return (M,) int32, per row of a its mutually nearest row of b, or −1 (Lowe 2004, §7.1).

    Args:
        a: (M, 4) uint64 descriptors.
        b: (N, 4) uint64 descriptors.
        max_hamming: Largest distance in bits.
        max_ratio: Largest ratio of best to second-best distance.
    """
    owner = np.full(len(b), -1, np.int32)
    best_of_b = np.full(len(b), 257, np.int32)
    matched = np.full(len(a), -1, np.int32)
    for i in range(len(a)):
        best, second, best_j = nearest_among(a, i, b, 0, len(b), best_of_b, owner)
        if best <= max_hamming and best <= max_ratio * second:
            matched[i] = best_j
    drop_one_sided(matched, owner)
    return matched
