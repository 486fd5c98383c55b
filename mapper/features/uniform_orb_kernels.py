"""FAST corners, their orientations, and their even distribution over an image, compiled.

OpenCV's detector finds the same scores but is slower for the two thresholds per cell of uniform ORB: the
finest level of a 640×480 image takes 0.7 ms here, 1.5 ms by one call at the lower threshold, before corners
are chosen by cell, and 4.7 ms by one call per cell (CPU time on fr1/xyz). A whole
detection takes 8 ms here, and would take 13 or 20 ms. OpenCV also drops both of two equal neighbours where
the first is kept here, so 6 % of the key points would change.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Image

Pixels = NDArray[np.int32]
"""(N, 2) column and row."""

# Bresenham circle of radius 3, clockwise from the top, as (column, row) offsets.
_CIRCLE = np.array(
    [
        (0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
        (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3),
    ]
)  # fmt: skip
RADIUS_PX = 3
PATCH_RADIUS_PX = 15
_BLOCK = 512  # pixels per step; the buffers stay in the first-level cache

_OFFSETS = np.arange(-PATCH_RADIUS_PX, PATCH_RADIUS_PX + 1)
_DISC = (np.add.outer(_OFFSETS**2, _OFFSETS**2) <= PATCH_RADIUS_PX**2).astype(np.uint8)
_DEPTH = 12  # 4096 columns and rows of leaves: finer than any image's pixels


@njit(cache=True, nogil=True)
def fast_scores(image: Image, threshold: int, margin_px: int) -> Image:
    """Return the score of every FAST-9 corner of an image, 0 elsewhere (Rosten & Drummond 2006).

    A corner has nine contiguous pixels of its circle all brighter, or all darker, than its centre by more
    than the threshold; the score is the largest threshold at which it still is one. Whole rows are
    processed at once without a branch, which compiles to vector instructions.

    Args:
        image: (H, W) uint8.
        threshold: Grey levels, at least 1.
        margin_px: Rows and columns left out along the border, at least ``RADIUS_PX``.
    """
    height, width = image.shape
    scores = np.zeros((height, width), np.uint8)
    if min(height, width) <= 2 * margin_px:
        return scores
    flat, flat_scores = image.ravel(), scores.ravel()
    around = _CIRCLE[:, 1] * width + _CIRCLE[:, 0]
    low, high = np.empty((8, _BLOCK), np.uint8), np.empty((8, _BLOCK), np.uint8)
    low_fours, high_fours = np.empty((8, _BLOCK), np.uint8), np.empty((8, _BLOCK), np.uint8)
    brightest, darkest = np.empty(_BLOCK, np.uint8), np.empty(_BLOCK, np.uint8)
    end = (height - margin_px) * width - margin_px
    for start in range(margin_px * width + margin_px, end, _BLOCK):
        n = min(_BLOCK, end - start)
        # Extremes over arcs of 2, 4 and 8 pixels that begin at odd positions are built from each other. The
        # two arcs of nine around an arc of eight differ in one end only, and the better end is enough.
        for k in range(8):
            a, b = start + around[2 * k + 1], start + around[(2 * k + 2) % 16]
            _join(low[k], high[k], flat[a : a + n], flat[a : a + n], flat[b : b + n], flat[b : b + n])
        for k in range(8):
            j = (k + 1) % 8
            _join(low_fours[k], high_fours[k], low[k, :n], high[k, :n], low[j], high[j])
        for k in range(8):
            j = (k + 2) % 8
            _join(low[k], high[k], low_fours[k, :n], high_fours[k, :n], low_fours[j], high_fours[j])
        brightest[:] = 0
        darkest[:] = 255
        for k in range(8):
            a, b = start + around[2 * k], start + around[(2 * k + 9) % 16]
            _widen(brightest, darkest, low[k], high[k], flat[a : a + n], flat[b : b + n])
        _score(
            flat_scores[start : start + n], flat[start : start + n], brightest, darkest, np.uint8(threshold)
        )
    scores[:, :margin_px] = 0  # rows were processed as one line, whose row ends are not valid
    scores[:, width - margin_px :] = 0
    return scores


@njit(inline="always")
def _join(low: Image, high: Image, low_a: Image, high_a: Image, low_b: Image, high_b: Image) -> None:
    for i in range(len(low_a)):
        low[i] = min(low_a[i], low_b[i])
        high[i] = max(high_a[i], high_b[i])


@njit(inline="always")
def _widen(brightest: Image, darkest: Image, low: Image, high: Image, end_a: Image, end_b: Image) -> None:
    for i in range(len(end_a)):
        brightest[i] = max(brightest[i], min(low[i], max(end_a[i], end_b[i])))
        darkest[i] = min(darkest[i], max(high[i], min(end_a[i], end_b[i])))


@njit(inline="always")
def _score(scores: Image, centre: Image, brightest: Image, darkest: Image, limit: np.uint8) -> None:
    for i in range(len(scores)):
        above = np.uint8(brightest[i] - min(brightest[i], centre[i]))
        below = np.uint8(centre[i] - min(darkest[i], centre[i]))
        contrast = max(above, below)
        scores[i] = np.uint8(contrast - 1) if contrast > limit else np.uint8(0)


@njit(cache=True, nogil=True)
def corners(scores: Image, threshold: int, cell_px: int, margin_px: int) -> tuple[Pixels, NDArray[np.uint8]]:
    """Return the local maxima of the scores, weak ones only from cells without strong ones.

    In square cells in which no corner reaches the threshold every corner is kept (Mur-Artal & Tardós 2017).
    Of equal neighbours the first is the maximum.

    Args:
        scores: (H, W) uint8 of ``fast_scores``, taken at the lower threshold.
        threshold: Score of a strong corner.
        cell_px: Side of a cell.
        margin_px: First row and column of the first cell, at least 1.

    Returns:
        (N, 2) int32 column and row, row by row, and their (N,) uint8 scores.
    """
    height, width = scores.shape
    best = np.zeros((height // cell_px + 1, width // cell_px + 1), np.uint8)
    found = np.empty((height * width // 4 + 1, 2), np.int32)  # no two maxima touch
    peaks = np.zeros((width + 7) // 8 * 8, np.uint8)
    words = peaks.view(np.uint64)  # eight pixels per test, as peaks are rare
    count = 0
    for y in range(margin_px, height - margin_px):
        _mark_peaks(peaks[1 : width - 1], scores[y - 1], scores[y], scores[y + 1])
        for word in np.flatnonzero(words):
            for x in range(8 * word, 8 * word + 8):
                if peaks[x] > 0 and margin_px <= x < width - margin_px:
                    found[count] = x, y
                    count += 1
                    row, column = (y - margin_px) // cell_px, (x - margin_px) // cell_px
                    best[row, column] = max(best[row, column], peaks[x])
    kept = 0
    strength = np.empty(count, np.uint8)
    for i in range(count):
        x, y = found[i]
        score = scores[y, x]
        if score >= threshold or best[(y - margin_px) // cell_px, (x - margin_px) // cell_px] < threshold:
            found[kept] = x, y
            strength[kept] = score
            kept += 1
    return found[:kept].copy(), strength[:kept].copy()


@njit(inline="always")
def _mark_peaks(peaks: Image, above: Image, row: Image, below: Image) -> None:
    """Write the scores of a row, less its two ends, where they are local maxima, and 0 elsewhere."""
    for i in range(len(peaks)):
        before = max(max(above[i], above[i + 1]), max(above[i + 2], row[i]))
        after = max(max(below[i], below[i + 1]), max(below[i + 2], row[i + 2]))
        peaks[i] = row[i + 1] if (row[i + 1] > before) & (row[i + 1] >= after) else np.uint8(0)


@njit(cache=True, nogil=True)
def orientations(image: Image, pixels: Pixels) -> NDArray[np.float32]:
    """Return (N,) radians from each pixel to the intensity centroid (Rublee et al. 2011, eq. 1–3).

    Args:
        image: (H, W) uint8.
        pixels: (N, 2) column and row, at least ``PATCH_RADIUS_PX`` from the border.
    """
    angles = np.empty(len(pixels), np.float32)
    size = 2 * PATCH_RADIUS_PX + 1
    for i in range(len(pixels)):
        x, y = pixels[i]
        moment_x, moment_y = 0, 0
        for dy in range(-PATCH_RADIUS_PX, PATCH_RADIUS_PX + 1):
            row = image[y + dy, x - PATCH_RADIUS_PX : x - PATCH_RADIUS_PX + size]
            weights = _DISC[dy + PATCH_RADIUS_PX]
            total, lever = np.int32(0), np.int32(0)
            for k in range(size):
                level = np.int32(row[k] * weights[k])
                total = np.int32(total + level)
                lever = np.int32(lever + np.int32(level * np.int32(k - PATCH_RADIUS_PX)))
            moment_x += int(lever)
            moment_y += dy * int(total)
        angles[i] = math.atan2(moment_y, moment_x)
    return angles


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
