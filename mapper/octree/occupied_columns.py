"""Occupied voxels of an octree by column, and the height of the ground where streets rise and fall."""

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.octree.keys import BLOCK_BITS, KEY_COUNT, KEY_MASK, KEY_ZERO, block_keys
from mapper.octree.sparse_grid import check_memory

if TYPE_CHECKING:
    from mapper.octree.queries import MapView

Tops = NDArray[np.int32]

_COLUMN_BYTES = 50
"""Peak memory of floor and slice for each column of the map's bounding box, measured."""
NOWHERE = -(1 << 30)
"""Height of the floor in a column without any, in voxels."""

_CELL_M = 3.0
_MAX_SLOPE = 0.3
_LOW_PERCENT = 20.0  # below it are reflections
_START_M = 0.5
_MIN_COLUMNS = 4
NEAR_FLOOR_M = 1.0
"""Near floor the ground is at its height, and drops are obstacles."""
NOTHING = np.iinfo(np.int32).max
"""Value of ``lowest_occupied`` for a column without an occupied voxel."""


class Columns(NamedTuple):
    """Occupied voxels of every column, in order of height; compiled functions take it as it is.

    Attributes:
        starts: (H·W + 1,) start of each column's voxels; columns run along x first.
        tops: (N,) upper face of each voxel, in voxels above z = 0.
        shape: H, W.
        first: (2,) x and y keys of the column of row 0 and column 0.
        resolution_m: Edge of a voxel.
    """

    starts: NDArray[np.int64]
    tops: Tops
    shape: tuple[int, int]
    first: NDArray[np.int64]
    resolution_m: float

    @property
    def column_of(self) -> NDArray[np.int64]:
        """(N,) number of each voxel's column."""
        return np.searchsorted(self.starts, np.arange(len(self.tops)), "right") - 1

    def with_tops(self, columns: NDArray[np.int64], tops: Tops) -> "Columns":
        """Return these columns and further voxels, given by their (M,) column numbers and tops."""
        keys = _keys(self.column_of, self.tops)  # voxels of a column are in order, so it orders all of them
        added = np.setdiff1d(_keys(columns, tops), keys)
        places = np.searchsorted(keys, added)
        starts = starts_of(added >> 17, len(self.starts) - 1)
        starts += self.starts
        tops = np.insert(self.tops, places, (added & (1 << 17) - 1) - KEY_ZERO)
        return self._replace(starts=starts, tops=tops)


def starts_of(columns: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the (count + 1,) start of each column's voxels, given the columns of all voxels in order.

    The columns may be far more than the voxels, so this allocates nothing else of their number.
    """
    starts = np.zeros(count + 1, np.int64)
    np.add.at(starts, columns + 1, 1)
    np.cumsum(starts, out=starts)
    return starts


def _keys(columns: NDArray[np.int64], tops: Tops) -> NDArray[np.int64]:
    """Return column · 2¹⁷ + top: a top lies one above the highest key at most."""
    return (columns << 17) | (tops.astype(np.int64) + KEY_ZERO)


def block_extent(octree: "MapView") -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the (2,) x and y keys of the first column of any block, and those after the last column."""
    keys = block_keys(octree.blocks.codes)[:, :2]
    if not len(keys):
        return np.full(2, KEY_ZERO), np.full(2, KEY_ZERO)
    return keys.min(axis=0), keys.max(axis=0) + (1 << BLOCK_BITS)


def occupied_columns(octree: "MapView", *, margin: int) -> Columns:
    """Return the occupied voxels of a map by column, with a margin of some columns around its blocks."""
    return columns_of(
        occupied_voxels(octree), block_extent(octree), margin=margin, resolution_m=octree.resolution_m
    )


def occupied_voxels(octree: "MapView") -> NDArray[np.int64]:
    """Return the (N,) occupied voxels of a map, or of a part of one, for ``columns_of``."""
    parts = [np.empty(0, np.int64)]
    for occupied in octree.leaves_by_part(lowest=octree.occupied_log_odds):
        x, y, z = occupied.keys.T.astype(np.int64)
        parts.append((y << 32) | (x << 16) | z)
    return np.concatenate(parts)


def columns_of(
    voxels: NDArray[np.int64],
    extent: tuple[NDArray[np.int64], NDArray[np.int64]],
    *,
    margin: int,
    resolution_m: float,
) -> Columns:
    """Return voxels by column.

    Args:
        voxels: (N,) from ``occupied_voxels``, those of all parts of the map; they are sorted in place.
        extent: Extent of all parts, from ``block_extent``.
        margin: Number of columns added around it.
        resolution_m: Edge of a voxel.

    Raises:
        MapSizeError: The floor of all columns would not fit into memory.
    """
    first, last = np.maximum(extent[0] - margin, 0), np.minimum(extent[1] + margin, KEY_COUNT)
    width, height = (int(n) for n in last - first)
    check_memory(
        width * height * _COLUMN_BYTES,
        f"a floor of {width * resolution_m:.0f} × {height * resolution_m:.0f} m in cells of "
        f"{resolution_m:g} m",
        remedy="raise octree.resolution_m, or map parts of the log",
    )
    voxels.sort()  # by y, then x, then z
    columns = ((voxels >> 32) - first[1]) * width + (voxels >> 16 & KEY_MASK) - first[0]
    starts = starts_of(columns, height * width)
    tops = ((voxels & KEY_MASK) + 1 - KEY_ZERO).astype(np.int32)
    return Columns(starts, tops, (height, width), first, resolution_m)


class Rows(Protocol):
    """An (H, W) int32 raster that is read some rows at a time, so that it need not be in memory."""

    @property
    def shape(self) -> tuple[int, ...]:
        """H, W."""
        ...

    def __getitem__(self, rows: slice, /) -> NDArray[np.int32]:
        """Return a slice of rows."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class GroundHeights:
    """Heights of the ground in square cells of a few metres, linearly interpolated between their centres.

    Attributes:
        heights_m: (R, C) heights in the world at the cells' centres.
        first: (2,) x and y key of the first column of cell (0, 0).
        columns: Edge of a cell in voxels.
    """

    heights_m: Array
    first: NDArray[np.int64]
    columns: int

    def under(self, *, first: NDArray[np.int64], shape: tuple[int, int]) -> Array:
        """Return the (H, W) height, metres, under each column of a grid; ``first`` are its x and y keys."""
        (x, y), (height, width) = first - self.first, shape
        by_row = _between(self.heights_m, (np.arange(y, y + height) + 0.5) / self.columns - 0.5)
        return _between(by_row.T, (np.arange(x, x + width) + 0.5) / self.columns - 0.5).T


def _between(values: Array, positions: Array) -> Array:
    """Return the rows at fractional positions; beyond the first and the last row their values hold."""
    positions = np.clip(positions, 0.0, len(values) - 1.0)
    below = np.minimum(positions.astype(np.int64), max(len(values) - 2, 0))
    share = (positions - below)[:, np.newaxis]
    above = np.minimum(below + 1, len(values) - 1)
    found: Array = values[below] * (1.0 - share) + values[above] * share
    return found


@dataclass(frozen=True, slots=True, eq=False)
class DrivenGround:
    """Floor that is connected to the ground under a path.

    Attributes:
        heights: (H, W) int32 heights of the lowest such floor in voxels above z = 0; NOWHERE where there is
            none. The columns are those of all blocks of the map, and any others that the
            footprint passed over.
        swept: (H, W) mask of what the footprint passed over.
        first: (2,) x and y keys of the column of row 0 and column 0.
    """

    heights: NDArray[np.int32]
    swept: NDArray[np.bool_]
    first: NDArray[np.int64]


def ground_heights(
    octree: "MapView",
    *,
    first: NDArray[np.int64],
    shape: tuple[int, int],
    floor_z_m: float,
    driven: DrivenGround | None = None,
) -> Array:
    """Return the (H, W) height of the ground in the world, metres, under each column of a grid.

    Where floor is connected to the path, it is the ground, and within a metre of it the nearest of it is.
    Farther away, in each cell of a few metres, the ground is a low percentile of the lowest occupied voxels.
    It is followed from the floor outwards, no steeper than a street: at a larger step (a roof, a wall, a
    lower yard) the height of the neighbour is kept.

    Args:
        octree: The map in a world with z up.
        first: (2,) x and y keys of the column of row 0 and column 0.
        shape: H, W.
        floor_z_m: Height of the floor near x = y = 0, from which the ground is followed if no driven ground
            is known.
        driven: Floor that was driven on, in the same columns.
    """
    lowest = lowest_occupied(octree, first=first, shape=shape)
    known = known_floor(driven)
    ground = ground_from_lowest(
        lowest, first=first, resolution_m=octree.resolution_m, floor_z_m=floor_z_m, floor=known
    )
    heights_m = ground.under(first=first, shape=shape)
    if known is not None:
        snap_to_floor(heights_m, *nearest_heights(known), resolution_m=octree.resolution_m)
    return heights_m


def known_floor(driven: DrivenGround | None) -> NDArray[np.int32] | None:
    """Return the (H, W) heights of driven ground; None where there is none at all."""
    return None if driven is None or not (driven.heights > NOWHERE).any() else driven.heights


def snap_to_floor(
    heights_m: Array, level: NDArray[np.int32], distances: NDArray[np.float32], *, resolution_m: float
) -> None:
    """Set the ground within a metre of floor to the nearest floor.

    Args:
        heights_m: (H, W) ground in the world, metres; changed in place.
        level: (H, W) heights of the nearest floor, in voxels above z = 0, from ``nearest_heights``.
        distances: (H, W) distances to it in columns, from there too.
        resolution_m: Edge of a voxel.
    """
    near = distances * resolution_m <= NEAR_FLOOR_M
    heights_m[near] = level[near] * resolution_m


def nearest_heights(heights: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the (H, W) height of the nearest column that has one, and its distance in columns."""
    missing = heights == NOWHERE
    distances, labels = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    height_of = np.empty(int(labels.max()) + 1, np.int32)
    height_of[labels[~missing]] = heights[~missing]
    level: NDArray[np.int32] = height_of[labels]
    return level, np.asarray(distances, np.float32)


def lowest_occupied(
    octree: "MapView", *, first: NDArray[np.int64], shape: tuple[int, int]
) -> NDArray[np.int32]:
    """Return the (H, W) top of each column's lowest occupied voxel, in voxels above z = 0.

    A column without one has ``NOTHING``, so that the minimum joins several maps.
    """
    lowest = np.full(shape, NOTHING, dtype=np.int32)
    for occupied in octree.leaves_by_part(lowest=octree.occupied_log_odds):
        x, y, z = occupied.keys.T.astype(np.int64)
        rows, columns = y - first[1], x - first[0]
        inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
        np.minimum.at(lowest, (rows[inside], columns[inside]), (z[inside] - KEY_ZERO + 1).astype(np.int32))
    return lowest


def ground_from_lowest(
    lowest: Rows,
    *,
    first: NDArray[np.int64],
    resolution_m: float,
    floor_z_m: float,
    floor: NDArray[np.int32] | None,
) -> GroundHeights:
    """Return the ground in cells of a few metres; see ``ground_heights``.

    Args:
        lowest: (H, W) result of ``lowest_occupied``.
        first: (2,) x and y keys of the column of row 0 and column 0.
        resolution_m: Edge of a voxel.
        floor_z_m: Height of the floor near x = y = 0, from which the ground is followed if no floor is known.
        floor: (H, W) heights of known floor in voxels above z = 0, NOWHERE elsewhere; None if none is known.
    """
    columns = max(1, round(_CELL_M / resolution_m))
    low_m = _cells(lowest, columns, _LOW_PERCENT, NOTHING) * resolution_m
    heights_m = np.full(low_m.shape, np.nan)
    if floor is not None:
        heights_m = _cells(floor, columns, 50.0, NOWHERE) * resolution_m
    if np.isnan(heights_m).all():  # no floor is known, or too little for any cell
        floors = np.argwhere(np.abs(low_m - floor_z_m) <= _START_M)
        if not len(floors):
            return GroundHeights(np.full(low_m.shape, floor_z_m), first, columns)
        origin = (KEY_ZERO - first[::-1]) // columns
        start = tuple(floors[np.argmin(((floors - origin) ** 2).sum(axis=1))].tolist())
        heights_m[start] = low_m[start]
    _follow(low_m, heights_m, max_step_m=_MAX_SLOPE * columns * resolution_m)
    return GroundHeights(heights_m, first, columns)


def _cells(tops: Rows, columns: int, percent: float, nothing: int) -> Array:
    """Return a percentile of the heights in squares of such edges; NaN where few columns have one."""
    rows_of, columns_of = (-(-size // columns) for size in tops.shape)
    cells = np.full((rows_of, columns_of), np.nan)
    for row in range(rows_of):
        band = tops[row * columns : (row + 1) * columns]
        for column in range(columns_of):
            found = band[:, column * columns : (column + 1) * columns]
            found = found[found != nothing]
            if len(found) >= _MIN_COLUMNS:
                cells[row, column] = np.percentile(found, percent)
    return cells


def _follow(low_m: Array, heights_m: Array, *, max_step_m: float) -> None:
    """Write the ground in every cell, breadth first from those whose height is known."""
    queue = deque(map(tuple, np.argwhere(~np.isnan(heights_m)).tolist()))
    while queue:
        row, column = queue.popleft()
        here_m = heights_m[row, column]
        for neighbour in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if not (0 <= neighbour[0] < low_m.shape[0] and 0 <= neighbour[1] < low_m.shape[1]):
                continue
            if np.isnan(heights_m[neighbour]):
                heights_m[neighbour] = (
                    low_m[neighbour] if abs(low_m[neighbour] - here_m) <= max_step_m else here_m
                )
                queue.append(neighbour)
