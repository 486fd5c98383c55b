"""Occupied voxels of an octree by column, in order of height, for ground plans and surfaces."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.octree.blocks import check_memory
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_COUNT, KEY_MASK, KEY_ZERO, block_keys, gather

if TYPE_CHECKING:
    from mapper.octree.map import OctreeMap

Tops = NDArray[np.int32]

_COLUMN_BYTES = 50
"""Peak memory of floor and slice for each column of the map's bounding box, measured."""
NOWHERE = -(1 << 30)
"""Height of the floor in a column without any, in voxels."""


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


def block_extent(octree: "OctreeMap") -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the (2,) x and y keys of the first column of any block, and those after the last column."""
    keys = block_keys(octree.blocks.codes)[:, :2]
    if not len(keys):
        return np.full(2, KEY_ZERO), np.full(2, KEY_ZERO)
    return keys.min(axis=0), keys.max(axis=0) + (1 << BLOCK_BITS)


def occupied_columns(octree: "OctreeMap", *, margin: int) -> Columns:
    """Return the occupied voxels of a map by column, with a margin of some columns around its blocks."""
    return columns_of(
        occupied_voxels(octree), block_extent(octree), margin=margin, resolution_m=octree.resolution_m
    )


def occupied_voxels(octree: "OctreeMap") -> NDArray[np.int64]:
    """Return the (N,) occupied voxels of a map, or of a part of one, for ``columns_of``."""
    voxels: NDArray[np.int64] = _occupied(
        octree.blocks.codes, octree.blocks.table.values, octree.occupied_log_odds
    )
    return voxels


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
        margin: So many columns are added around it.
        resolution_m: Edge of a voxel.

    Raises:
        MapSizeError: The floor of so many columns would not fit into memory.
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


@njit(cache=True, nogil=True)
def _occupied(
    codes: NDArray[np.int64], values: NDArray[np.float32], threshold: np.float32
) -> NDArray[np.int64]:
    """Return the keys of all occupied voxels as y · 2³² + x · 2¹⁶ + z."""
    count = 0
    for b in range(len(codes)):
        for voxel in range(BLOCK_VOXELS):
            count += values[b, voxel] >= threshold
    packed = np.empty(count, np.int64)
    count = 0
    for b in range(len(codes)):
        for voxel in range(BLOCK_VOXELS):
            if values[b, voxel] >= threshold:
                code = (codes[b] << (3 * BLOCK_BITS)) | voxel
                packed[count] = (gather(code >> 1) << 32) | (gather(code) << 16) | gather(code >> 2)
                count += 1
    return packed
