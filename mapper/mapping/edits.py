"""Edits by hand: regions of a map that are erased, kept or blocked."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Points32
from mapper.core.geometry import Array, Points, Transform, apply
from mapper.mapping.config import AppliedEdit, Edits, Region
from mapper.navigation.traversable_grid import Storey, TraversableFloor, trim
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.keys import (
    BLOCK_EDGE,
    BLOCK_VOXELS,
    KEY_BITS,
    KEY_MASK,
    KEY_ZERO,
    block_keys,
    gather,
)
from mapper.octree.map import OctreeMap
from mapper.octree.occupied_columns import NOWHERE, Columns, DrivenGround, nearest_heights
from mapper.octree.sparse_grid import BLOCKS_AT_ONCE

Mask = NDArray[np.bool_]

_X, _Y, _Z = (gather.py_func(np.arange(BLOCK_VOXELS) >> axis) for axis in range(3))


@dataclass(frozen=True, slots=True, eq=False)
class MapEditor:
    """Editor of the maps of a run, or of the grids of a map that it was merged into.

    Attributes:
        edits: What to do.
        path_world: (N, 3) where the sensor was in the run's world, metres.
        room_m: Height of a robot: floor belongs to a region if any of the space of a robot on it does.
        T_world_map: (4, 4) pose of the merged map in the run's world; None for the run's own maps.
    """

    edits: Edits
    path_world: Points
    room_m: float
    T_world_map: Transform | None = None

    def erase(self, octree: OctreeMap) -> list[AppliedEdit]:
        """Free the occupied voxels whose centres lie in regions to erase."""
        done = []
        for region in self.edits.erase:
            count = sum(octree.set_free(slots, inside) for slots, inside in self._voxels(octree, region))
            done.append(AppliedEdit(kind="erase", region=region, count=count))
        return done

    def crop(self, octree: OctreeMap) -> list[AppliedEdit]:
        """Make the voxels unknown whose centres lie in none of the regions to keep, if there are any.

        Raises:
            DataError: Nothing of the map would be left.
        """
        kept = np.zeros((len(octree.blocks), BLOCK_VOXELS // 8), np.uint8)
        done = []
        for region in self.edits.keep:
            count = 0
            for slots, inside in self._voxels(octree, region):
                kept[slots] |= np.packbits(inside, axis=1)
                count += int(np.count_nonzero(inside & ~np.isnan(octree.blocks.table.values[slots])))
            done.append(AppliedEdit(kind="keep", region=region, count=count))
        if done and not any(edit.count for edit in done):
            raise DataError(
                f"edits: the map has no voxel in a region to keep ({'; '.join(edit.text for edit in done)})"
            )
        for slots in _chunks(np.arange(len(octree.blocks))) if done else ():
            octree.set_unknown(slots, ~np.unpackbits(kept[slots], axis=1).view(np.bool_))
        return done

    def crop_ground(self, driven: DrivenGround, columns: Columns) -> DrivenGround:
        """Return the driven ground, swept only in regions to keep, if there are any."""
        if not self.edits.keep:
            return driven
        first_world = (columns.first - KEY_ZERO).astype(np.float64) * columns.resolution_m
        floor = _Cells(first_world, driven.heights, columns.resolution_m)
        return replace(driven, swept=driven.swept & self._on_floor(self.edits.keep, floor))

    def edit_floor(self, floor: TraversableFloor) -> tuple[TraversableFloor, list[AppliedEdit]]:
        """Return a floor cropped and with its keep-out regions blocked.

        Storeys of which nothing is left are gone. The path begins on the first storey that is left if its own
        is gone.
        """
        if not self.edits.keep and not self.edits.keepout:
            return floor, []
        blocked = np.zeros(len(self.edits.keepout), np.int64)
        storeys = [self._edited(storey, blocked) for storey in floor.storeys]
        links = [self._edited(link, np.zeros_like(blocked)) for link in floor.links]
        left = [number for number, storey in enumerate(storeys) if _is_known(storey)] or [0]
        home_number = left.index(floor.home_number) if floor.home_number in left else 0
        done = [
            AppliedEdit(kind="keepout", region=region, count=int(count))
            for region, count in zip(self.edits.keepout, blocked, strict=True)
        ]
        kept = tuple(storeys[number] for number in left)
        return TraversableFloor(kept, home_number, tuple(filter(_is_known, links))), done

    def keepout(self, grid: OccupancyGrid, level: NDArray[np.int32]) -> OccupancyGrid | None:
        """Return where the keep-out regions are, in the cells of a slice; None if there are none.

        Args:
            grid: The slice.
            level: (H, W) heights of the floor below it, in voxels above z = 0.
        """
        if not self.edits.keepout:
            return None
        inside = self._on_floor(self.edits.keepout, _Cells(grid.origin_world_m, level, grid.resolution_m))
        cells = np.where(inside, OCCUPIED, FREE).astype(np.int8)
        return OccupancyGrid(cells, grid.origin_world_m, grid.resolution_m)

    def keep_out(self, points: Points) -> Mask:
        """Return for each of (N, 3) points, metres, whether it lies in a keep-out region."""
        return self._contain(
            self.edits.keepout, points if self.T_world_map is None else apply(self.T_world_map, points)
        )

    def leave(self, points_world: Points | Points32) -> Mask:
        """Return for each of (N, 3) points, metres, whether nothing that is done in regions takes it away."""
        left = ~self._contain(self.edits.erase, points_world)
        return left & self._contain(self.edits.keep, points_world) if self.edits.keep else left

    def _contain(self, regions: tuple[Region, ...], points_world: Points | Points32) -> Mask:
        inside = np.zeros(len(points_world), np.bool_)
        for region in regions:
            low_m, high_m = region.z_range_m
            in_height = np.flatnonzero((points_world[:, 2] >= low_m) & (points_world[:, 2] <= high_m))
            inside[in_height] |= covered(region, points_world[in_height, :2], self.path_world)
        return inside

    def _edited(self, storey: Storey, blocked: NDArray[np.int64]) -> Storey:
        """Return a storey after the edits; add the cells that each keep-out region blocks to (K,) counts."""
        if not (storey.heights > NOWHERE).any():
            return trim(storey)
        cells = storey.grid.cells.copy()
        heights, _ = nearest_heights(storey.heights)
        floor = _Cells(storey.grid.origin_world_m, heights, storey.grid.resolution_m)
        if self.edits.keep:
            cells[~self._on_floor(self.edits.keep, floor)] = UNKNOWN
        for number, region in enumerate(self.edits.keepout):
            inside = self._on_floor((region,), floor)
            blocked[number] += np.count_nonzero(cells[inside] != OCCUPIED)
            cells[inside] = OCCUPIED
        return trim(replace(storey, grid=replace(storey.grid, cells=cells)))

    def _voxels(self, octree: OctreeMap, region: Region) -> Iterator[tuple[NDArray[np.int64], Mask]]:
        """Yield (B,) slots of blocks that a region may overlap, and the (B, 512) mask of its voxels."""
        keys, layer = block_keys(octree.blocks.codes), np.flatnonzero(_Z == 0)
        low_m, high_m = region.z_range_m
        z_m = _centres(keys[:, 2:] + np.arange(BLOCK_EDGE), octree)
        in_height = (z_m >= low_m) & (z_m <= high_m)
        slots = np.flatnonzero(in_height.any(axis=1))
        columns, column_of = np.unique(keys[slots, 0] << KEY_BITS | keys[slots, 1], return_inverse=True)
        x = (columns >> KEY_BITS)[:, np.newaxis] + _X[layer]
        y = (columns & KEY_MASK)[:, np.newaxis] + _Y[layer]
        centres_world = _centres(np.column_stack([x.ravel(), y.ravel()]), octree)
        in_plan = np.empty((len(columns), BLOCK_EDGE, BLOCK_EDGE), np.bool_)
        in_plan[:, _X[layer], _Y[layer]] = covered(region, centres_world, self.path_world).reshape(x.shape)
        anywhere: Mask = np.logical_or.reduce(in_plan, axis=(1, 2))
        for some in _chunks(np.flatnonzero(anywhere[column_of])):
            inside = in_plan[column_of[some]][:, _X, _Y] & in_height[slots[some]][:, _Z]
            yield slots[some], inside

    def _on_floor(self, regions: tuple[Region, ...], floor: "_Cells") -> Mask:
        """Return the (H, W) mask of the cells on whose floor a robot is in any of the regions."""
        points = np.column_stack([floor.centres_world, (floor.heights * floor.resolution_m).ravel()])
        if self.T_world_map is not None:
            points = apply(self.T_world_map, points)
        inside = np.zeros(len(points), np.bool_)
        for region in regions:
            low_m, high_m = region.z_range_m
            in_height = (points[:, 2] + self.room_m >= low_m) & (points[:, 2] <= high_m)
            inside |= in_height & covered(region, points[:, :2], self.path_world)
        return inside.reshape(floor.heights.shape)


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Cells of a grid with the (H, W) heights of their floor, voxels above z = 0."""

    origin_world_m: Array
    heights: NDArray[np.int32]
    resolution_m: float

    @property
    def centres_world(self) -> Points:
        """(H · W, 2) x and y of the cells' centres, metres."""
        rows, columns = np.indices(self.heights.shape).reshape(2, -1)
        return self.origin_world_m + (np.column_stack([columns, rows]) + 0.5) * self.resolution_m


def covered(region: Region, points_world: Points | Points32, path_world: Points) -> Mask:
    """Return the (N,) mask of (N, 2) points that lie in a region seen from above.

    Args:
        region: The region.
        points_world: x and y, metres.
        path_world: (P, 3) where the sensor was, metres.
    """
    inside = np.ones(len(points_world), np.bool_)
    if region.box_m is not None:
        low_m, high_m = np.array(region.box_m)[:, :2]
        inside &= ((points_world >= low_m) & (points_world <= high_m)).all(axis=1)
    if region.polygon_m is not None:
        inside &= _in_polygon(points_world, np.array(region.polygon_m))
    if region.path_radius_m is not None:
        from scipy.spatial import cKDTree  # takes half a second

        path = cKDTree(path_world[:, :2])
        distance_m, _ = path.query(points_world, distance_upper_bound=region.path_radius_m)
        inside &= np.isfinite(distance_m)
    return inside


def _is_known(storey: Storey) -> bool:
    return bool((storey.grid.cells != UNKNOWN).any())


def _in_polygon(points: Points | Points32, corners: Points) -> Mask:
    """Return the (N,) mask of (N, 2) points from which a ray along x crosses an odd number of sides."""
    inside = np.zeros(len(points), np.bool_)
    x, y = points.T
    for (x_a, y_a), (x_b, y_b) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y_a != y_b:
            crosses = (y_a > y) != (y_b > y)
            inside ^= crosses & (x < x_a + (y - y_a) * (x_b - x_a) / (y_b - y_a))
    return inside


def _centres(keys: NDArray[np.int64], octree: OctreeMap) -> Array:
    return ((keys - KEY_ZERO).astype(np.float64) + 0.5) * octree.resolution_m


def _chunks(slots: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for first in range(0, len(slots), BLOCKS_AT_ONCE):
        yield slots[first : first + BLOCKS_AT_ONCE]
