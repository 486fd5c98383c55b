"""Matching of predicted pixels to features in a search window around them, compiled."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.features.hamming import hamming

CELL_PX = 16


@dataclass(frozen=True, slots=True, eq=False)
class FeatureGrid:
    """Index of features sorted by square cell, so that the candidates of a search are adjacent in memory.

    Attributes:
        start: (cells + 1,) int32 first feature of each cell; cells run row by row.
        columns: Number of cells in a row.
        rows: Number of rows of cells.
    """

    start: NDArray[np.int32]
    columns: int
    rows: int


def sort_into_grid(
    pixels: NDArray[np.float64], *, width_px: int, height_px: int
) -> tuple[NDArray[np.intp], FeatureGrid]:
    """Return the order that sorts (N, 2) pixels by cell, and the grid of the sorted pixels.

    Pixels that undistortion moved outside the image are in the border cells.
    """
    columns, rows = -(-width_px // CELL_PX), -(-height_px // CELL_PX)
    cell = np.clip(pixels // CELL_PX, 0, [columns - 1, rows - 1]).astype(np.int32)
    index = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(index, kind="stable")
    start = np.searchsorted(index[order], np.arange(columns * rows + 1)).astype(np.int32)
    return order, FeatureGrid(start, columns, rows)


@njit(cache=True, nogil=True)
def match_windows(
    predicted,
    predicted_octave,
    radius_px,
    predicted_bits,
    pixels,
    octave,
    bits,
    taken,
    start,
    columns,
    rows,
    max_hamming,
    max_ratio,
):
    """Return (M,) int32, per prediction the matching feature or −1; no feature matches two predictions.

    The best candidate within ``radius_px`` and ±1 octave matches if its distance is at most ``max_hamming``
    and, if the second best is of the same octave, at most ``max_ratio`` of that distance (Lowe 2004, §7.1).

    Args:
        predicted: (M, 2) float64 pixels.
        predicted_octave: (M,) int32.
        radius_px: (M,) float64 search radius.
        predicted_bits: (M, 4) uint64 descriptors.
        pixels: (N, 2) float64 features' pixels, sorted by cell.
        octave: (N,) int32 features' octaves.
        bits: (N, 4) uint64 features' descriptors.
        taken: (N,) bool: features to leave out.
        start: As in ``FeatureGrid``, likewise the next two.
        columns: Number of cells in a row.
        rows: Number of rows of cells.
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
                d = hamming(predicted_bits, m, bits, f)
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
