"""2D navigation map: a horizontal band of the octree projected onto the ground plane."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array
from mapper.octree.config import SliceConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.keys import BLOCK_EDGE, KEY_ZERO, block_keys
from mapper.octree.occupied_columns import (
    DrivenGround,
    block_extent,
    ground_heights,
    known_floor,
    nearest_heights,
)

if TYPE_CHECKING:
    from mapper.octree.queries import MapView

SEEN_FREE, SEEN_OCCUPIED = 1, 2
"""States of a column, of which it may have both."""


@dataclass(frozen=True, slots=True)
class Band:
    """Band of heights above the floor that a slice shows.

    Attributes:
        config: Heights of the band, and the smallest group of occupied cells.
        resolution_m: Edge of a voxel.
        floor_z_m: Height of the floor in the world.
    """

    config: SliceConfig
    resolution_m: float
    floor_z_m: float = 0.0

    def flags(
        self,
        octree: "MapView",
        *,
        first: NDArray[np.int64],
        shape: tuple[int, int],
        ground_m: Array | None,
    ) -> NDArray[np.uint8]:
        """Return (H, W) uint8 flags of the states of the band's voxels in each column; ``or`` joins maps.

        Args:
            octree: A map, or a part of one, that lies inside the grid.
            first: (2,) x and y keys of the column of row 0 and column 0.
            shape: H, W.
            ground_m: (H, W) height of the ground that the band follows; None if it is level.

        Raises:
            DataError: The band has no voxels.
        """
        lowest, highest = self._keys()
        slots, bases = octree.blocks.sorted_slots(), np.zeros(shape, dtype=np.int64)
        if ground_m is not None:
            bases += np.rint((ground_m - self.floor_z_m) / self.resolution_m).astype(np.int64)
        z = block_keys(octree.blocks.codes[slots])[:, 2]
        slots = slots[
            (z + BLOCK_EDGE > lowest + bases.min(initial=0)) & (z <= highest + bases.max(initial=0))
        ]
        seen = np.zeros(shape, dtype=np.uint8)
        for known in octree.leaves_by_part(slots):
            x, y, z = known.keys.T.astype(np.int64)
            rows, columns = y - first[1], x - first[0]
            z -= bases[rows, columns]
            inside = (z >= lowest) & (z <= highest)
            occupied = known.log_odds >= octree.occupied_log_odds
            for flag, some in ((SEEN_FREE, inside & ~occupied), (SEEN_OCCUPIED, inside & occupied)):
                seen[rows[some], columns[some]] |= np.uint8(flag)
        return seen

    def free_path(self, seen: NDArray[np.uint8], driven: DrivenGround) -> None:
        """Flag the columns as free that what carried the sensor passed; of a level band, those of its storey.

        Args:
            seen: (H, W) flags in the columns of ``driven``; changed in place.
            driven: The ground that was driven on.
        """
        swept = driven.swept
        if self.config.above == "floor":
            above_floor_m = driven.heights * self.resolution_m - self.floor_z_m
            swept = swept & (np.abs(above_floor_m) <= self.config.min_height_m)
        seen[swept] = SEEN_FREE

    def grid_of(self, seen: NDArray[np.uint8], *, first: NDArray[np.int64]) -> OccupancyGrid:
        """Return flags as a grid, cropped to its known cells.

        Args:
            seen: (H, W) the flags.
            first: (2,) x and y keys of the column of row 0 and column 0.

        Raises:
            DataError: No voxel of the band is known.
        """
        config = self.config
        if not seen.any():
            raise DataError(
                f"slice: nothing is known {config.min_height_m:g} to {config.max_height_m:g} m above the "
                f"floor at z = {self.floor_z_m:g} m; set slice.min_height_m and slice.max_height_m to where "
                "the map is"
            )
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        seen = _without_speckles(
            seen[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], min_cells=config.min_cluster_cells
        )
        cells = np.full(seen.shape, UNKNOWN, dtype=np.int8)
        cells[seen & SEEN_FREE != 0] = FREE
        cells[seen & SEEN_OCCUPIED != 0] = OCCUPIED
        corner = np.array([first[0] + columns[0], first[1] + rows[0]]) - KEY_ZERO
        return OccupancyGrid(cells, corner * self.resolution_m, self.resolution_m)

    def floor_below(self, grid: OccupancyGrid, driven: DrivenGround | None) -> NDArray[np.int32]:
        """Return the (H, W) heights of the floor below a slice's cells, in voxels above z = 0.

        That of a level band is the floor; below another it is the nearest floor connected to the path.

        Args:
            grid: The slice.
            driven: The ground that was driven on, of the same map; None if none is known.
        """
        known = known_floor(driven) if self.config.above == "ground" else None
        if driven is None or known is None:
            return np.full(grid.cells.shape, round(self.floor_z_m / grid.resolution_m), np.int32)
        first = np.rint(grid.origin_world_m / grid.resolution_m).astype(np.int64) + KEY_ZERO
        (x, y), (height, width) = first - driven.first, grid.cells.shape
        return nearest_heights(known)[0][y : y + height, x : x + width]

    def _keys(self) -> tuple[int, int]:
        """Return the lowest and the highest z key whose voxel centres lie in the band."""
        config, resolution_m = self.config, self.resolution_m
        bottom_m, top_m = self.floor_z_m + config.min_height_m, self.floor_z_m + config.max_height_m
        # The allowance includes centres on the edge, such as 0.075 m at 5 cm, whatever the rounding.
        lowest = int(np.ceil(bottom_m / resolution_m - 0.5 - 1e-9)) + KEY_ZERO
        highest = int(np.floor(top_m / resolution_m - 0.5 + 1e-9)) + KEY_ZERO
        if lowest > highest:
            raise DataError(
                f"slice: no voxel of {resolution_m:g} m has its centre {config.min_height_m:g} to "
                f"{config.max_height_m:g} m above the floor; raise slice.max_height_m"
            )
        return lowest, highest


def cut_between(octree: "MapView", z_min: float, z_max: float | None) -> OccupancyGrid:
    """Return the band between two heights of the world; without the upper one, the voxels at the lower.

    Raises:
        DataError: A height is not finite, or the upper one is not the higher.
    """
    heights = (z_min,) if z_max is None else (z_min, z_max)
    if not np.isfinite(heights).all() or (z_max is not None and z_max <= z_min):
        raise DataError(f"slice: from {z_min} to {z_max} m; want finite heights, the lower one first")
    if z_max is None:  # a height on a border belongs to the voxel above it, as in a query
        layer = np.floor((1.0 / octree.resolution_m) * z_min)
        z_min, z_max = layer * octree.resolution_m, (layer + 1.0) * octree.resolution_m
    return cut_slice(octree, SliceConfig(min_height_m=z_min, max_height_m=z_max))


def cut_slice(octree: "MapView", config: SliceConfig, *, driven: DrivenGround | None = None) -> OccupancyGrid:
    """Return the band between two heights above the floor, z = 0, as a grid just large enough for it.

    A voxel belongs to the band if its centre does. A cell is occupied if any voxel of its column is, else
    free if any is, else unknown. In too small a group of occupied cells, occupied voxels do not count. Where
    what carried the sensor passed, the cell is free: obstacles lower than the sensor are left out of that.

    Args:
        octree: The map in a world with z up.
        config: Heights and the smallest group.
        driven: The ground that was driven on, of the same map; None if none is known.

    Raises:
        DataError: The band has no voxels, or none that is known.
    """
    if driven is None:
        first, last = block_extent(octree)
        shape = int(last[1] - first[1]), int(last[0] - first[0])
    else:
        first, shape = driven.first, driven.swept.shape
    band, ground_m = Band(config, octree.resolution_m), None
    if config.above == "ground":
        ground_m = ground_heights(octree, first=first, shape=shape, floor_z_m=band.floor_z_m, driven=driven)
    seen = band.flags(octree, first=first, shape=shape, ground_m=ground_m)
    if driven is not None:
        band.free_path(seen, driven)
    return band.grid_of(seen, first=first)


def _without_speckles(seen: NDArray[np.uint8], *, min_cells: int) -> NDArray[np.uint8]:
    """Return ``seen`` without the occupied flag of 8-connected groups smaller than ``min_cells``."""
    if min_cells == 1:
        return seen
    occupied = (seen & SEEN_OCCUPIED).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(occupied, connectivity=8)
    small = stats[:, cv2.CC_STAT_AREA] < min_cells
    small[0] = False  # label 0 is everything that is not occupied
    return np.where(small[labels], seen & ~np.uint8(SEEN_OCCUPIED), seen)
