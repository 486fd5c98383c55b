"""Mutual nearest matching of any descriptors, and the homography filter of Somlyai (PhD thesis), alg. 8."""

from typing import Protocol

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.features.base import Descriptors
from mapper.features.hamming import popcount

Pairs = NDArray[np.intp]
"""(M, 2) indices into the first and the second image's features."""

_HOMOGRAPHY_POINTS = 4
TOLERANCE_PX = 4.0
"""ε of alg. 8, which the thesis leaves open."""


class Described(Protocol):
    """Anything with descriptors, one per row: an image's features, a keyframe's view."""

    @property
    def descriptors(self) -> Descriptors:
        """(N, D) uint8 bits or float32."""
        ...


def match_mutual(a: Described, b: Described, *, max_ratio: float) -> Pairs:
    """Return the pairs of mutually nearest descriptors that pass the ratio test (Lowe 2004, §7.1).

    Every descriptor is compared with every other: Hamming distance for bits, Euclidean for numbers.

    Args:
        a: Features of the first image.
        b: Features of the second image, of the same detector.
        max_ratio: Largest distance of a's best partner relative to its second best.

    Returns:
        (M, 2) pairs, ascending in a's index.

    Raises:
        DataError: The descriptors are of different kinds.
    """
    if a.descriptors.dtype != b.descriptors.dtype or a.descriptors.shape[1] != b.descriptors.shape[1]:
        raise DataError(
            f"matching: descriptors {a.descriptors.shape} {a.descriptors.dtype} and {b.descriptors.shape} "
            f"{b.descriptors.dtype} are of different kinds; use one detector for both images"
        )
    if len(a.descriptors) == 0 or len(b.descriptors) == 0:
        return np.empty((0, 2), np.intp)
    if a.descriptors.dtype == np.uint8:
        pairs: Pairs = _match_bits(_words(a.descriptors), _words(b.descriptors), max_ratio)
        return pairs
    nearest: Pairs = _match_numbers(
        a.descriptors @ b.descriptors.T, _squares(a.descriptors), _squares(b.descriptors), max_ratio
    )
    return nearest


def homography_inliers(a: NDArray[np.float32], b: NDArray[np.float32], *, seed: int = 0) -> NDArray[np.bool_]:
    """Return the inliers of the homography that most pairs agree with (Somlyai, PhD thesis, alg. 8).

    RANSAC over four pairs (Fischler & Bolles 1981), by OpenCV.

    Args:
        a: (M, 2) pixels in the first image.
        b: (M, 2) their partners in the second.
        seed: Seed of the samples; see ``drawing_order``.

    Returns:
        (M,) mask; all False when no homography exists.
    """
    agree = np.zeros(len(a), np.bool_)
    if len(a) < _HOMOGRAPHY_POINTS:
        return agree
    order = drawing_order(len(a), seed)
    found, mask = cv2.findHomography(a[order], b[order], cv2.RANSAC, TOLERANCE_PX)
    if found is not None:
        agree[order] = mask.ravel()
    return agree


def drawing_order(count: int, seed: int) -> NDArray[np.intp]:
    """Return the order of the pairs for OpenCV's RANSAC: unchanged for seed 0, else shuffled.

    OpenCV draws the same random numbers every time, so only another order gives other samples.
    """
    if seed == 0:
        return np.arange(count, dtype=np.intp)
    return np.random.default_rng(seed).permutation(count)


def _words(descriptors: Descriptors) -> NDArray[np.uint64]:
    """Return the bits as (N, W) whole words, padded with zeros."""
    n, width = descriptors.shape
    padded = np.zeros((n, -(-width // 8) * 8), np.uint8)
    padded[:, :width] = descriptors
    return padded.view(np.uint64)


def _squares(descriptors: Descriptors) -> NDArray[np.float32]:
    squares: NDArray[np.float32] = np.einsum("ij,ij->i", descriptors, descriptors)
    return squares


@njit(cache=True, nogil=True)
def _match_bits(a: NDArray[np.uint64], b: NDArray[np.uint64], max_ratio: float) -> Pairs:
    distances = np.empty((len(a), len(b)), np.float32)
    words = a.shape[1]
    for i in range(len(a)):
        for j in range(len(b)):
            differing = np.uint64(0)
            for k in range(words):
                differing += popcount(a[i, k] ^ b[j, k])
            distances[i, j] = differing
    nearest: Pairs = _match_distances(distances, max_ratio)
    return nearest


@njit(cache=True, nogil=True)
def _match_numbers(
    products: NDArray[np.float32],
    squares_a: NDArray[np.float32],
    squares_b: NDArray[np.float32],
    max_ratio: float,
) -> Pairs:
    """Return the mutually nearest rows from (N, M) scalar products: |a - b|² = |a|² + |b|² - 2 a·b."""
    squared = np.empty_like(products)
    for i in range(len(squares_a)):
        for j in range(len(squares_b)):
            squared[i, j] = max(
                squares_a[i] + squares_b[j] - np.float32(2.0) * products[i, j], np.float32(0.0)
            )
    nearest: Pairs = _match_distances(squared, max_ratio**2)
    return nearest


@njit(cache=True, nogil=True)
def _match_distances(distances: NDArray[np.float32], max_ratio: float) -> Pairs:
    """Return the entries of an (N, M) table that are smallest in row and column, the first among equals."""
    rows, columns = distances.shape
    column_best = np.full(columns, np.inf, np.float32)
    column_row = np.zeros(columns, np.intp)
    partner = np.zeros(rows, np.intp)
    distinct = np.zeros(rows, np.bool_)
    for i in range(rows):
        best, second = np.float32(np.inf), np.float32(np.inf)
        for j in range(columns):
            distance = distances[i, j]
            if distance < best:
                best, second, partner[i] = distance, best, j
            elif distance < second:
                second = distance
            if distance < column_best[j]:
                column_best[j] = distance
                column_row[j] = i
        distinct[i] = best < max_ratio * second
    pairs = np.empty((rows, 2), np.intp)
    count = 0
    for i in range(rows):
        if distinct[i] and column_row[partner[i]] == i:
            pairs[count] = i, partner[i]
            count += 1
    return pairs[:count].copy()
