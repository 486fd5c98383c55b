"""Even distribution of key points over an image by a quadtree (Zhao et al. 2020, §1.1, steps 4–7)."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

_DEPTH = 12  # 4096 columns and rows of leaves: finer than any image's pixels


@njit(cache=True, nogil=True)
def spread(
    pixels: NDArray[np.int32], strength: NDArray[np.uint8], width_px: int, height_px: int, wanted: int
) -> NDArray[np.intp]:
    """Return the indices, ascending, of the strongest point in each node of a quadtree with ``wanted`` nodes.

    Every node with more than one point is split, level by level, while that gives no more than the wanted
    number of nodes; on the last level the fullest nodes are split first.

    Args:
        pixels: (N, 2) column and row.
        strength: (N,) uint8; among equals the first along the Z-order curve wins.
        width_px: Width of the root node.
        height_px: Height of the root node.
        wanted: Largest number of indices.
    """
    n = len(pixels)
    if n <= wanted:
        return np.arange(n)
    # Along the Z-order curve a node's points are neighbours: at depth d they share the first 2·d bits.
    codes = np.empty(n, np.int64)
    for i in range(n):
        codes[i] = _interleave((pixels[i, 0] << _DEPTH) // width_px, (pixels[i, 1] << _DEPTH) // height_px)
    order = np.argsort(codes)
    codes = codes[order]
    depth, starts = 0, np.array([0, n])
    while depth < _DEPTH:
        finer = _starts(codes, 0, n, depth + 1)
        if len(finer) - 1 > wanted:
            break
        depth, starts = depth + 1, finer
    kept = np.empty(wanted, np.intp)
    count, spare = 0, wanted - (len(starts) - 1)
    for node in np.argsort(starts[:-1] - starts[1:], kind="mergesort"):
        begin, end = starts[node], starts[node + 1]
        parts = _starts(codes, begin, end, depth + 1) if depth < _DEPTH else np.array([begin, end])
        if len(parts) - 2 > spare:
            parts = np.array([begin, end])
        spare -= len(parts) - 2
        for k in range(len(parts) - 1):
            kept[count] = order[parts[k] + np.argmax(strength[order[parts[k] : parts[k + 1]]])]
            count += 1
    return np.sort(kept[:count])


@njit(cache=True, nogil=True)
def _interleave(column: int, row: int) -> int:
    code = 0
    for bit in range(_DEPTH):
        code |= ((column >> bit) & 1) << (2 * bit) | ((row >> bit) & 1) << (2 * bit + 1)
    return code


@njit(cache=True, nogil=True)
def _starts(codes: NDArray[np.int64], begin: int, end: int, depth: int) -> NDArray[np.intp]:
    """Return where each node of a depth begins among sorted codes, and the end."""
    shift = 2 * (_DEPTH - depth)
    starts = np.empty(end - begin + 1, np.intp)
    count = 0
    for i in range(begin, end):
        if i == begin or codes[i] >> shift != codes[i - 1] >> shift:
            starts[count] = i
            count += 1
    starts[count] = end
    return starts[: count + 1].copy()
