"""Matching predicted pixels to nearby features; compiled, as it runs for every map point of every frame."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.features.bits import popcount

CELL_PX = 16

Words = NDArray[np.uint64]
"""(N, 4) uint64: a 256-bit binary descriptor in four words."""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureGrid:
    """Where the features of each square cell begin, once they are sorted by cell.

    Sorted, the candidates of a search lie side by side in memory.

    Attributes:
        start: (cells + 1,) int32 first feature of each cell; cells run row by row.
        columns: How many cells a row has.
        rows: How many rows of cells.
    """

    start: NDArray[np.int32]
    columns: int
    rows: int


def pack(descriptors: NDArray[np.uint8] | NDArray[np.float32]) -> Words:
    """Return (N, 32) uint8 binary descriptors as (N, 4) words."""
    return np.ascontiguousarray(descriptors).view(np.uint64).reshape(-1, 4)


def sort_into_grid(
    pixels: NDArray[np.float64], *, width_px: int, height_px: int
) -> tuple[NDArray[np.intp], FeatureGrid]:
    """Return the order that sorts (N, 2) pixels by cell, and the grid of the sorted pixels.

    Pixels that undistortion pushed outside the image join the border cells.
    """
    columns, rows = -(-width_px // CELL_PX), -(-height_px // CELL_PX)
    cell = np.clip(pixels // CELL_PX, 0, [columns - 1, rows - 1]).astype(np.int32)
    index = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(index, kind="stable")
    start = np.searchsorted(index[order], np.arange(columns * rows + 1)).astype(np.int32)
    return order, FeatureGrid(start, columns, rows)


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
def match_windows(
    predicted,
    predicted_octave,
    radius_px,
    predicted_words,
    pixels,
    octave,
    words,
    taken,
    start,
    columns,
    rows,
    max_hamming,
    max_ratio,
):
    """Return, per prediction, the matching feature or −1; no feature serves two predictions.

    The best candidate within ``radius_px`` and ±1 octave wins if its distance is at most ``max_hamming``
    and, against the runner-up of the same octave, at most ``max_ratio`` of its distance (Lowe 2004).

    Args:
        predicted: (M, 2) float64 pixels.
        predicted_octave: (M,) int32.
        radius_px: (M,) float64 search radius.
        predicted_words: (M, 4) uint64 descriptors.
        pixels: (N, 2) float64 features' pixels, sorted by cell.
        octave: (N,) int32 features' octaves.
        words: (N, 4) uint64 features' descriptors.
        taken: (N,) bool: features that are not to be used.
        start: The FeatureGrid's.
        columns: The FeatureGrid's.
        rows: The FeatureGrid's.
        max_hamming: Largest distance in bits.
        max_ratio: Largest ratio of best to second-best distance.
    """
    matched = np.full(len(predicted), -1, np.int32)
    owner = np.full(len(pixels), -1, np.int32)
    distance_of = np.full(len(pixels), 257, np.int32)
    for m in range(len(predicted)):
        u, v, r = predicted[m, 0], predicted[m, 1], radius_px[m]
        left = max(int((u - r) // CELL_PX), 0)
        right = min(int((u + r) // CELL_PX), columns - 1)
        top = max(int((v - r) // CELL_PX), 0)
        bottom = min(int((v + r) // CELL_PX), rows - 1)
        if right < left or bottom < top:
            continue  # the window lies wholly outside the image
        best, second, best_octave, second_octave, best_feature = 257, 257, -1, -1, -1
        for row in range(top, bottom + 1):
            for f in range(start[row * columns + left], start[row * columns + right + 1]):
                if taken[f] or abs(octave[f] - predicted_octave[m]) > 1:
                    continue
                if abs(pixels[f, 0] - u) > r or abs(pixels[f, 1] - v) > r:
                    continue
                d = hamming(predicted_words, m, words, f)
                if d < best:
                    second, second_octave = best, best_octave
                    best, best_octave, best_feature = d, octave[f], f
                elif d < second:
                    second, second_octave = d, octave[f]
        if best > max_hamming or (second_octave == best_octave and best > max_ratio * second):
            continue
        if best < distance_of[best_feature]:
            if owner[best_feature] >= 0:
                matched[owner[best_feature]] = -1
            owner[best_feature] = m
            distance_of[best_feature] = best
            matched[m] = best_feature
    return matched


@njit(cache=True, nogil=True)
def nearest_among(a, i, b, first, end, best_of_b, owner):
    """Return the two smallest distances from row i of a to rows of b, and the nearest of these.

    Args:
        a: (M, 4) uint64 descriptors.
        i: The row.
        b: (N, 4) uint64 descriptors.
        first: First row of b to compare.
        end: The row after the last.
        best_of_b: (N,) int32 smallest distance that each row of b has met so far; kept up to date.
        owner: (N,) int32 row of a that it met it in; kept up to date.
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
def drop_unrequited(matched, owner):
    """Undo the matches (M,) whose partner is nearer to another row, its ``owner`` (N,)."""
    for i in range(len(matched)):
        if matched[i] >= 0 and owner[matched[i]] != i:
            matched[i] = -1


@njit(cache=True, nogil=True)
def match_everywhere(a, b, max_hamming, max_ratio):
    """Return, per row of a, its mutually nearest row of b or −1; for when there is no prediction.

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
    drop_unrequited(matched, owner)
    return matched
