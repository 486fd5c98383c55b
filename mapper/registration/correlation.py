"""Correlative matching of planar scans (Olson 2009): motions under which most points coincide."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, planar_motion

_COARSE = 4
"""Cells along the edge of those that are compared first, by the most that any motion in them can reach."""
_SMEARED = 3
"""Cells from a point at which a likelihood field falls to a hundredth."""
_MOST_CELLS = 4000
"""Along an edge of a likelihood field: 200 m in cells of 5 cm; farther points are left out of it."""


def correlate(
    target: Points,
    source: Points,
    *,
    reach_m: float,
    cell_m: float,
    peaks: int,
    apart_m: float,
    apart_rad: float,
) -> list[tuple[float, Transform]]:
    """Return the planar motions of the source, in any heading, that most of its points support, best first.

    A point supports a motion that brings it into the cell of a target's point or next to it. All headings are
    tried, and all positions in reach: first in cells of 4 × 4, which no position in them can exceed, and then
    within those that may hold the best.

    Args:
        target: (N, 3) points, one per cell or so, metres; z is not used.
        source: (M, 3) the same of the scan that moves.
        reach_m: Largest translation along x and along y.
        cell_m: Edge of a cell.
        peaks: Largest number of motions.
        apart_m: Two motions differ by this distance, or
        apart_rad: by this angle in heading.

    Returns:
        Support, 0 … 1, and the (4, 4) motion T_target_source.
    """
    if not len(target) or not len(source):
        return []
    farthest_m = float(np.hypot(source[:, 0], source[:, 1]).max())
    turns = int(np.ceil(2.0 * np.pi * max(farthest_m, 1.0) / (2.0 * cell_m)))
    steps = int(np.ceil(reach_m / (_COARSE * cell_m))) * _COARSE
    edge = int(np.ceil(max(np.abs(target[:, :2]).max(), farthest_m) / cell_m)) + steps + 2 * _COARSE
    fine = _occupied(target, 2 * edge, cell_m)
    coarse = _pooled(fine)
    supports = _coarse_supports(coarse, source, turns, steps, cell_m)
    found: list[tuple[float, Transform]] = []
    order = np.argsort(-supports, axis=None, kind="stable")
    best = np.zeros(0)
    for _ in range(peaks):
        kept = np.array([[*T[:2, 3], np.arctan2(T[1, 0], T[0, 0])] for _, T in found]).reshape(-1, 3)
        best = _best_motion(fine, source, supports, order, turns, steps, cell_m, kept, apart_m, apart_rad)
        if best[0] <= 0.0:
            break
        found.append((float(best[0] / len(source)), planar_motion(*best[1:].tolist())))
    return found


@njit(cache=True, nogil=True)
def _occupied(points, width, cell_m):
    """Return a (width, width) grid about the origin: 2 in the cells of points, 1 next to them."""
    grid = np.zeros((width, width), np.uint8)
    for n in range(len(points)):
        x = int(np.floor(points[n, 0] / cell_m)) + width // 2
        y = int(np.floor(points[n, 1] / cell_m)) + width // 2
        for i in range(max(x - 1, 0), min(x + 2, width)):
            for j in range(max(y - 1, 0), min(y + 2, width)):
                grid[i, j] = max(grid[i, j], 2 if i == x and j == y else 1)
    return grid


@njit(cache=True, nogil=True)
def _pooled(grid):
    """Return the largest value in the square of cells that begins at each."""
    width = len(grid)
    pooled = np.zeros_like(grid)
    for i in range(width):
        for j in range(width):
            most = 0
            for k in range(i, min(i + _COARSE, width)):
                for m in range(j, min(j + _COARSE, width)):
                    most = max(most, grid[k, m])
            pooled[i, j] = most
    return pooled


@njit(cache=True, nogil=True)
def _turned(source, turn, turns, width, cell_m):
    """Return the (M, 2) cells of the source's points at a heading."""
    cosine, sine = np.cos(2.0 * np.pi * turn / turns), np.sin(2.0 * np.pi * turn / turns)
    cells = np.empty((len(source), 2), np.int64)
    for n in range(len(source)):
        x, y = source[n, 0], source[n, 1]
        cells[n, 0] = int(np.floor((cosine * x - sine * y) / cell_m)) + width // 2
        cells[n, 1] = int(np.floor((sine * x + cosine * y) / cell_m)) + width // 2
    return cells


@njit(cache=True, nogil=True)
def _support(grid, cells, i, j):
    support = 0
    for n in range(len(cells)):
        support += grid[cells[n, 0] + i, cells[n, 1] + j]
    return support


@njit(cache=True, nogil=True)
def _coarse_supports(coarse, source, turns, steps, cell_m):
    """Return (turns, C, C): the most support that a motion in each square of cells can have."""
    count = 2 * steps // _COARSE
    supports = np.zeros((turns, count, count), np.int64)
    for turn in range(turns):
        cells = _turned(source, turn, turns, len(coarse), cell_m)
        for a in range(count):
            for b in range(count):
                supports[turn, a, b] = _support(coarse, cells, a * _COARSE - steps, b * _COARSE - steps)
    return supports


@njit(cache=True, nogil=True)
def _best_motion(fine, source, supports, order, turns, steps, cell_m, kept, apart_m, apart_rad):
    """Return the support, x, y and heading of the best motion that differs from those kept; 0 without any."""
    best, count = np.zeros(4), supports.shape[1]
    last_turn, cells = -1, np.empty((0, 2), np.int64)
    for index in order:
        turn, a, b = index // (count * count), index // count % count, index % count
        if supports[turn, a, b] <= 2.0 * best[0]:
            break
        if turn != last_turn:
            cells, last_turn = _turned(source, turn, turns, len(fine), cell_m), turn
        for i in range(a * _COARSE - steps, (a + 1) * _COARSE - steps):
            for j in range(b * _COARSE - steps, (b + 1) * _COARSE - steps):
                support = 0.5 * _support(fine, cells, i, j)
                if support <= best[0]:
                    continue
                x, y, heading = i * cell_m, j * cell_m, 2.0 * np.pi * turn / turns
                is_new = True
                for k in range(len(kept)):
                    angle = abs((heading - kept[k, 2] + np.pi) % (2.0 * np.pi) - np.pi)
                    if np.hypot(x - kept[k, 0], y - kept[k, 1]) < apart_m and angle < apart_rad:
                        is_new = False
                if is_new:
                    best[0], best[1], best[2], best[3] = support, x, y, heading
    return best


@dataclass(frozen=True, slots=True, eq=False)
class LikelihoodField:
    """Likelihood field of planar points (Thrun, Burgard & Fox 2005, §6.4): 1 at a point, less beside it.

    Attributes:
        values: (X, Y) in cells.
        corner: (2,) x and y of cell 0, 0, metres.
        cell_m: Edge of a cell.
    """

    values: NDArray[np.float32]
    corner: Array
    cell_m: float

    @classmethod
    def of(cls, points: Points, cell_m: float) -> "LikelihoodField":
        """Return the field of (N, 3) points, metres; there is at least one."""
        middle = np.median(points[:, :2], axis=0)
        half = min(_MOST_CELLS // 2, int(np.abs(points[:, :2] - middle).max() / cell_m) + _SMEARED + 2)
        corner = (np.floor(middle / cell_m) - half) * cell_m
        return cls(_smeared(points, corner, 2 * half, cell_m), corner, cell_m)

    def best_near(
        self, source: Points, T_field_source: Transform, *, reach_m: float, reach_rad: float
    ) -> Transform:
        """Return the motion (4, 4) near a guess under which a scan is most likely; of equals, the nearest.

        Args:
            source: (N, 3) the scan.
            T_field_source: (4, 4) planar guess.
            reach_m: Largest distance from it along x and along y.
            reach_rad: Largest turn from it.
        """
        yaw_rad = float(np.arctan2(T_field_source[1, 0], T_field_source[0, 0]))
        lengths_m = np.hypot(source[:, 0], source[:, 1])
        step_rad = self.cell_m / max(2.0 * float(np.median(lengths_m)), 1.0)
        at = T_field_source[:2, 3] - self.corner
        steps = int(np.ceil(reach_m / self.cell_m)), int(np.ceil(reach_rad / step_rad))
        x, y, turn = _most_likely(self.values, source, at, yaw_rad, steps[0], steps[1], step_rad, self.cell_m)
        return planar_motion(
            T_field_source[0, 3] + x * self.cell_m,
            T_field_source[1, 3] + y * self.cell_m,
            yaw_rad + turn * step_rad,
        )


@njit(cache=True, nogil=True)
def _smeared(points, corner, width, cell_m):
    values = np.zeros((width, width), np.float32)
    for n in range(len(points)):
        x, y = int((points[n, 0] - corner[0]) / cell_m), int((points[n, 1] - corner[1]) / cell_m)
        if not (_SMEARED <= x < width - _SMEARED and _SMEARED <= y < width - _SMEARED):
            continue
        for i in range(-_SMEARED, _SMEARED + 1):
            for j in range(-_SMEARED, _SMEARED + 1):
                value = 0.01 ** ((i * i + j * j) / (_SMEARED * _SMEARED))
                values[x + i, y + j] = max(values[x + i, y + j], value)
    return values


@njit(cache=True, nogil=True)
def _most_likely(values, source, at, yaw_rad, reach, turns, step_rad, cell_m):
    """Return the cells along x and y, and the turn's steps, by which the best motion differs from a guess."""
    width, best, found = len(values), -1.0, (0, 0, 0)
    x, y = np.empty(len(source), np.int64), np.empty(len(source), np.int64)
    for turn in range(-turns, turns + 1):
        cosine, sine = np.cos(yaw_rad + turn * step_rad), np.sin(yaw_rad + turn * step_rad)
        for n in range(len(source)):
            x[n] = int(np.floor((cosine * source[n, 0] - sine * source[n, 1] + at[0]) / cell_m))
            y[n] = int(np.floor((sine * source[n, 0] + cosine * source[n, 1] + at[1]) / cell_m))
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                likelihood = 0.0
                for n in range(len(source)):
                    if 0 <= x[n] + i < width and 0 <= y[n] + j < width:
                        likelihood += values[x[n] + i, y[n] + j]
                likelihood *= 1.0 - 1e-3 * (abs(i) + abs(j) + abs(turn))
                if likelihood > best:
                    best, found = likelihood, (i, j, turn)
    return found
