"""Matching of predicted pixels to features in a search window around them, compiled."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.features.hamming import Bits, hamming

CELL_PX = 16


class FeatureGrid(NamedTuple):
    """Index of features sorted by square cell, so that the candidates of a search are adjacent in memory.

    Attributes:
        start: (cells + 1,) int32 first feature of each cell; cells run row by row.
        columns: Number of cells in a row.
        rows: Number of rows of cells.
    """

    start: NDArray[np.int32]
    columns: int
    rows: int


class SearchWindows(NamedTuple):
    """Windows of an image in which features are searched.

    Attributes:
        pixels: (M, 2) float64 predicted pixels, their centres.
        radius_px: (M,) float64 half of their edge.
        octave: (M,) int32 predicted octaves.
        bits: (M, 4) uint64 descriptors.
    """

    pixels: NDArray[np.float64]
    radius_px: NDArray[np.float64]
    octave: NDArray[np.int32]
    bits: Bits


class GridFeatures(NamedTuple):
    """Features of an image, sorted by cell.

    Attributes:
        pixels: (N, 2) float64.
        octave: (N,) int32.
        bits: (N, 4) uint64 descriptors.
        grid: Their index.
    """

    pixels: NDArray[np.float64]
    octave: NDArray[np.int32]
    bits: Bits
    grid: FeatureGrid


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
def match_windows(windows, features, taken, max_hamming, max_ratio):
    """Return (M,) int32, per window the matching feature or −1; no feature matches two windows.

    The best candidate within a window and ±1 octave matches if its distance is at most ``max_hamming`` and,
    if the second best is of the same octave, at most ``max_ratio`` of that distance (Lowe 2004, §7.1).

    Args:
        windows: ``SearchWindows``.
        features: ``GridFeatures``.
        taken: (N,) bool: features to leave out.
        max_hamming: Largest distance in bits.
        max_ratio: Largest ratio of best to second-best distance.
    """
    centre, radius_px, predicted_octave, predicted_bits = windows
    pixels, octave, bits, (start, columns, rows) = features
    matched = np.full(len(centre), -1, np.int32)
    owner = np.full(len(pixels), -1, np.int32)
    distance_of = np.full(len(pixels), 257, np.int32)
    for m in range(len(centre)):
        u, v, r = centre[m, 0], centre[m, 1], radius_px[m]
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
            assign(m, best_feature, best, matched, owner, distance_of)
    return matched


@njit(cache=True, nogil=True)
def assign(m, feature, distance, matched, owner, distance_of):
    """Match a feature to query m, and no longer to the one whose descriptor is farther from its own."""
    if owner[feature] >= 0:
        matched[owner[feature]] = -1
    owner[feature], distance_of[feature] = m, distance
    matched[m] = feature
