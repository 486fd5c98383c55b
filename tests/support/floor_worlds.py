"""Worlds of slabs and boxes: their exact occupancy, and where a robot can drive by their geometry alone."""

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise, product

import numpy as np

from mapper.navigation.reachable_floor import reachable_floor
from mapper.navigation.traversable_grid import traversable
from mapper.octree.config import OctreeConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_ZERO, codes_of_keys
from mapper.octree.map import OctreeMap
from mapper.octree.occupied_columns import NOWHERE

THICK_M = 0.2
PITCH_M = 0.1
SENSOR_M = 1.3


@dataclass(frozen=True)
class Slab:
    """Ground over a rectangle: z = z0 + rise · (x − x0, y − y0)."""

    x0: float
    x1: float
    y0: float
    y1: float
    z0: float = 0.0
    rise: tuple[float, float] = (0.0, 0.0)

    def z(self, x, y):
        return self.z0 + self.rise[0] * (x - self.x0) + self.rise[1] * (y - self.y0)

    def covers(self, x, y):
        return (x >= self.x0) & (x < self.x1) & (y >= self.y0) & (y < self.y1)


@dataclass(frozen=True)
class Block:
    """A box from z0 to z1; its top is ground too, if it can be reached."""

    x0: float
    x1: float
    y0: float
    y1: float
    z0: float
    z1: float


@dataclass
class World:
    """Slabs, blocks, the ground points of a path, and rectangles whose ground no ray reached."""

    slabs: list
    blocks: list = field(default_factory=list)
    path: list = field(default_factory=list)
    unseen: list = field(default_factory=list)

    def positions(self):
        """Return (N, 3) positions of the sensor along the path, 10 cm apart."""
        points = np.array(self.path, np.float64)
        pieces = [points[:1]]
        for a, b in pairwise(points):
            count = max(1, int(np.ceil(np.linalg.norm(b - a) / 0.1)))
            pieces.append(a + (b - a) * np.arange(1, count + 1)[:, np.newaxis] / count)
        return np.concatenate(pieces) + np.array([0.0, 0.0, SENSOR_M])

    def bounds(self):
        solids = [*self.slabs, *self.blocks]
        return (
            min(s.x0 for s in solids),
            max(s.x1 for s in solids),
            min(s.y0 for s in solids),
            max(s.y1 for s in solids),
        )

    def spans(self, x, y):
        """Return the solid height ranges at (N,) places: (N, S) lows and highs, NaN where there is none."""
        lows, highs = [], []
        for slab in self.slabs:
            top = np.where(slab.covers(x, y), slab.z(x, y), np.nan)
            lows.append(top - THICK_M)
            highs.append(top)
        for block in self.blocks:
            inside = (x >= block.x0) & (x < block.x1) & (y >= block.y0) & (y < block.y1)
            lows.append(np.where(inside, block.z0, np.nan))
            highs.append(np.where(inside, block.z1, np.nan))
        return np.array(lows).T, np.array(highs).T

    def octree(self, cell_m, *, seed=None):
        """Return the map of a sensor that saw every solid, but no ground in ``unseen``.

        With a seed, 5 % of the columns are missing and 3 % of the tops are a voxel higher.
        """
        x0, x1, y0, y1 = self.bounds()
        xs = (np.arange(np.floor(x0 / cell_m), np.ceil(x1 / cell_m)) + 0.5) * cell_m
        ys = (np.arange(np.floor(y0 / cell_m), np.ceil(y1 / cell_m)) + 0.5) * cell_m
        x, y = (a.ravel() for a in np.meshgrid(xs, ys))
        lows, highs = self.spans(x, y)
        rng = np.random.default_rng(seed or 0)
        missing = np.zeros(len(x), bool) if seed is None else rng.random(len(x)) < 0.05
        for a0, a1, b0, b1 in self.unseen:
            missing |= (x >= a0) & (x < a1) & (y >= b0) & (y < b1)
        keys = []
        for solid in range(lows.shape[1]):
            is_slab = solid < len(self.slabs)
            at = np.flatnonzero(~np.isnan(lows[:, solid]) & ~(missing & is_slab))
            bottom = np.floor(lows[at, solid] / cell_m + 1e-6).astype(np.int64)
            top = np.ceil(highs[at, solid] / cell_m - 1e-6).astype(np.int64)  # the key above the last voxel
            if seed is not None and is_slab:
                top += rng.random(len(at)) < 0.03
            for layer in range(int((top - bottom).max(initial=0))):
                z = bottom + layer
                some = z < top
                columns = np.column_stack([np.floor(x[at] / cell_m), np.floor(y[at] / cell_m), z])
                keys.append(columns[some].astype(np.int64) + KEY_ZERO)
        return octree_of_keys(np.concatenate(keys), cell_m)

    def reachable(self, *, step_m, slope, room_m):
        """Return {(i, j): heights} of the ground that can be reached from the path, at multiples of PITCH_M.

        Tops of slabs no steeper than ``slope`` and of blocks are ground where there is head room; one goes
        from place to place where the heights differ by no more than a step.

        Args:
            step_m: Largest step.
            slope: Largest rise over run.
            room_m: Head room.
        """
        x0, x1, y0, y1 = self.bounds()
        # A little off the middle, so that no place lies on the edge of a solid.
        xs, ys = (np.arange(low, high, PITCH_M) + 0.503 * PITCH_M for low, high in ((x0, x1), (y0, y1)))
        x, y = (a.ravel() for a in np.meshgrid(xs, ys))
        lows, highs = self.spans(x, y)
        gentle = [np.hypot(*s.rise) <= slope for s in self.slabs] + [True] * len(self.blocks)
        stand = {}
        for solid in np.flatnonzero(gentle):
            top = highs[:, solid]
            is_clear = ~np.isnan(top)
            for other in range(lows.shape[1]):
                if other != solid:
                    is_clear &= ~((lows[:, other] < top + room_m) & (highs[:, other] > top + 1e-6))
            for n in np.flatnonzero(is_clear):
                stand.setdefault((n // len(xs), n % len(xs)), []).append(top[n])
        first = self.path[0]
        start = int((first[1] - y0) / PITCH_M), int((first[0] - x0) / PITCH_M)
        seeds = [(start, z) for z in stand[start] if abs(z - first[2]) < 0.1]
        found, queue = set(seeds), deque(seeds)
        while queue:
            (i, j), z = queue.popleft()
            for beside in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                for height in stand.get(beside, ()):
                    if abs(height - z) <= step_m + 0.4 * PITCH_M and (beside, height) not in found:
                        found.add((beside, height))
                        queue.append((beside, height))
        result = {}
        for place, z in found:
            result.setdefault(place, []).append(z)
        return Truth((x0, y0), result)


@dataclass(frozen=True)
class Truth:
    """Heights of the reachable ground by place."""

    corner: tuple
    heights: dict

    def near(self, x, y, reach_m):
        """Return, for each place within a reach, the heights there."""
        lows = [
            int(np.floor((v - reach_m - c) / PITCH_M + 1e-6))
            for v, c in zip((y, x), self.corner[::-1], strict=True)
        ]
        highs = [
            int(np.floor((v + reach_m - c) / PITCH_M - 1e-6))
            for v, c in zip((y, x), self.corner[::-1], strict=True)
        ]
        return [
            self.heights.get((i, j), [])
            for i in range(lows[0], highs[0] + 1)
            for j in range(lows[1], highs[1] + 1)
        ]


@dataclass(frozen=True)
class Score:
    """Grids against the truth.

    Attributes:
        precision: Of the free cells, those within a cell of ground that can be reached.
        recall: Of the cells with only such ground in and around them, those that are free.
        path_blocked: Share of the path's points in a cell that is occupied on the storey below them.
        path_unknown: The same of unknown cells.
    """

    precision: float
    recall: float
    path_blocked: float
    path_unknown: float


_SAMPLES = 2000
"""Places that are looked at, about."""


def _agree(top, z, cell_m):
    """Return whether a height in voxels, or a gap that was closed, may be a true height."""
    return top == NOWHERE or abs(top * cell_m - z) <= 1.5 * cell_m + 0.1


def score(world, truth, octree, config):
    """Return how right the traversable floor of a world's map is; unseen ground is not asked for."""
    floor = reachable_floor(octree, config, positions_world=world.positions())
    storeys = traversable(floor, config).storeys
    cell = octree.resolution_m
    right = total = found = asked = 0
    by_place = {}
    for storey in storeys:
        cells = np.argwhere(storey.grid.cells == FREE)
        first = np.rint(storey.grid.origin_world_m / cell).astype(int)
        for number, (row, column) in enumerate(cells.tolist()):
            top = int(storey.heights[row, column])
            place = column + int(first[0]), row + int(first[1])
            by_place.setdefault(place, []).append(top)
            if number % max(1, len(cells) // _SAMPLES) == 0:
                near = truth.near(*((np.array(place) + 0.5) * cell), 1.5 * cell)
                total += 1
                right += any(_agree(top, z, cell) for heights in near for z in heights)
    x0, x1, y0, y1 = world.bounds()
    columns = range(int(np.ceil(x0 / cell)) + 1, int(x1 / cell) - 1)
    rows = range(int(np.ceil(y0 / cell)) + 1, int(y1 / cell) - 1)
    for number, place in enumerate(product(columns, rows)):
        if number % max(1, len(columns) * len(rows) // _SAMPLES):
            continue
        x, y = (np.array(place) + 0.5) * cell
        if any(
            low - cell <= x < high + cell and bottom - cell <= y < top + cell
            for low, high, bottom, top in world.unseen
        ):
            continue
        around = truth.near(x, y, 1.5 * cell)
        limit_m = 0.5 * config.max_step_m + 0.6 * cell
        for z in around[len(around) // 2]:
            # Ground all around, all of it less than a step away: no edge.
            if all(any(abs(other - z) <= limit_m for other in heights) for heights in around):
                asked += 1
                found += any(_agree(top, z, cell) for top in by_place.get(place, ()))
    codes = path_codes(world, storeys)
    return Score(
        right / max(total, 1), found / max(asked, 1), np.mean(codes == OCCUPIED), np.mean(codes == UNKNOWN)
    )


def path_codes(world, storeys):
    """Return the code of the cell below each point of the path, on the storey whose floor is nearest."""
    codes = []
    for x, y, z in world.positions() - np.array([0.0, 0.0, SENSOR_M]):
        best = (np.inf, UNKNOWN)
        for storey in storeys:
            grid = storey.grid
            column, row = np.floor((np.array([x, y]) - grid.origin_world_m) / grid.resolution_m).astype(int)
            if 0 <= row < grid.cells.shape[0] and 0 <= column < grid.cells.shape[1]:
                top = storey.heights[row, column]
                away = abs(top * grid.resolution_m - z) if top != NOWHERE else 10.0
                best = min(best, (away, int(grid.cells[row, column])))
        codes.append(best[1])
    return np.array(codes)


def octree_of_keys(keys, cell_m):
    """Return a map whose occupied voxels have these (N, 3) keys; nothing else is known."""
    octree = OctreeMap(OctreeConfig(resolution_m=cell_m, max_range_m=1e3))
    blocks = codes_of_keys(keys >> BLOCK_BITS)
    codes, slot = np.unique(blocks, return_inverse=True)
    voxel = codes_of_keys(keys & ((1 << BLOCK_BITS) - 1))  # the order in a block is that of the blocks
    known = np.zeros((len(codes), BLOCK_VOXELS), bool)
    known[slot, voxel] = True
    octree.restore_blocks(codes, known, np.full(int(known.sum()), 2.0, np.float32))
    return octree
