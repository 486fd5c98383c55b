"""Queries of an occupancy map: points, voxels, rays, nearest obstacles, and nodes of coarser levels."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapper.core.errors import DataError, expect_shape
from mapper.core.frames import Points32
from mapper.core.geometry import Array, Points, point_rows
from mapper.octree import query_kernels as kernels
from mapper.octree.config import OctreeConfig, Parent
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.keys import BLOCK_BITS, BLOCK_DEPTH, KEY_BITS, KEY_ZERO, codes_of, keys_of
from mapper.octree.ray_casting import origin_key
from mapper.octree.sparse_grid import BLOCKS_AT_ONCE, BlockStore, count_known, log_odds


@dataclass(frozen=True, slots=True, eq=False)
class Leaves:
    """Known voxels, or nodes above them, in Morton order.

    Attributes:
        keys: (N, 3) uint16 keys as in OctoMap; above the voxels they count nodes.
        log_odds: (N,) float32.
        resolution_m: Edge of a voxel.
        depth: Depth of the nodes in the tree; 16 is that of the voxels.
    """

    keys: NDArray[np.uint16]
    log_odds: NDArray[np.float32]
    resolution_m: float
    depth: int = KEY_BITS

    @property
    def edge_m(self) -> float:
        """Edge of a node."""
        return self.resolution_m * (1 << (KEY_BITS - self.depth))

    @property
    def centres_world(self) -> Points:
        """(N, 3) float64 centres, metres."""
        voxels = 1 << (KEY_BITS - self.depth)
        return (self.keys.astype(np.float64) * voxels - (KEY_ZERO - 0.5 * voxels)) * self.resolution_m


@dataclass(frozen=True, slots=True, eq=False)
class RayEnds:
    """Ends of rays cast through the map.

    Attributes:
        centres_world: (N, 3) float64 centre of the last voxel, metres.
        distances_m: (N,) float64 from the ray's origin to that centre.
        hits: (N,) bool, true where that voxel is occupied.
    """

    centres_world: Points
    distances_m: Array
    hits: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """Nearest obstacles of N points.

    Attributes:
        centres_world: (N, 3) float64 centre of the nearest occupied voxel, metres; NaN if none is in range.
            Of equally near ones it is the first in Morton order.
        distances_m: (N,) float64 to that centre; inf where none is in range.
    """

    centres_world: Points
    distances_m: Array


class MapView:
    """What can be asked of an occupancy map; an absent voxel is unknown."""

    config: OctreeConfig
    blocks: BlockStore

    @property
    def resolution_m(self) -> float:
        """Edge of a voxel."""
        return self.config.resolution_m

    @property
    def resolution(self) -> float:
        """Edge of a voxel, metres: ``resolution_m``."""
        return self.resolution_m

    @property
    def occupied_log_odds(self) -> np.float32:
        """Least log-odds of an occupied voxel."""
        return log_odds(self.config.occupied_probability)

    def __len__(self) -> int:
        """Return the number of known voxels, all at the finest level; counted at every call."""
        return int(count_known(self.blocks.table.values[: len(self.blocks)]))

    def __getitem__(self, points_world: ArrayLike) -> NDArray[np.int8]:
        """Return what :meth:`query` does: ``octree[x, y, z]`` of one point."""
        return self.query(points_world)

    def count_occupied(self) -> int:
        """Return how many of the known voxels are occupied; the others are free."""
        used = self.blocks.table.values[: len(self.blocks)]
        return int(np.count_nonzero(used >= self.occupied_log_odds))

    def __repr__(self) -> str:
        known, occupied = len(self), self.count_occupied()
        return (
            f"OctreeMap of {self.resolution_m:g} m voxels: {known} known, "
            f"{occupied} occupied and {known - occupied} free"
        )

    def query(self, points_world: ArrayLike) -> NDArray[np.int8]:
        """Return the states of points: 100 occupied, 0 free, -1 unknown or out of range.

        Args:
            points_world: (..., 3) metres, world frame.

        Returns:
            (...) int8 of ``OCCUPIED``, ``FREE`` and ``UNKNOWN`` of :mod:`mapper.octree.grid`.

        Raises:
            DataError: The points are not (..., 3) numbers.
        """
        values = self.log_odds_at(points_world)
        known = np.where(values >= self.occupied_log_odds, np.int8(OCCUPIED), np.int8(FREE))
        return np.where(np.isnan(values), np.int8(UNKNOWN), known)

    def probability(self, points_world: ArrayLike) -> NDArray[np.float32]:
        """Return the (...) probabilities, 0 … 1, that (..., 3) points are occupied; NaN where unknown."""
        odds: NDArray[np.float32] = np.exp(self.log_odds_at(points_world))
        return odds / (1.0 + odds)

    def log_odds_at(
        self, points_world: ArrayLike, *, depth: int = KEY_BITS, parent: Parent = "max"
    ) -> NDArray[np.float32]:
        """Return the (...) log-odds of (..., 3) points in metres; NaN where unknown or out of range.

        Args:
            points_world: Any points.
            depth: Level of the tree, 0 (root) … 16 (voxels). Others than 16 are computed for the whole map at
                every call.
            parent: Log-odds of a node above the voxels: ``max`` or ``mean`` of its known children.

        Raises:
            DataError: The points are not (..., 3) numbers, or there is no such depth or parent.
        """
        shape, rows = point_rows(points_world, "octree")
        found: NDArray[np.float32]
        if depth == KEY_BITS:
            found = kernels.values_at(self.blocks.table, rows, self.resolution_m)
            return found.reshape(shape)
        codes, values = self._nodes(depth, parent)
        values = np.append(values, np.float32(np.nan))
        wanted = codes_of(rows, self.resolution_m) >> (3 * (KEY_BITS - depth))  # −1 stays −1
        at = np.searchsorted(codes, wanted)
        at[np.append(codes, -2)[at] != wanted] = len(codes)
        found = values[at]
        return found.reshape(shape)

    def are_occupied(self, points_world: ArrayLike) -> NDArray[np.bool_]:
        """Return the (...) mask of the (..., 3) points, metres, that lie in occupied voxels."""
        return self.log_odds_at(points_world) >= self.occupied_log_odds

    def is_occupied(self, point_world: ArrayLike) -> bool:
        """Return whether the voxel around one point, (3,) metres, is occupied."""
        return bool(self.are_occupied(point_world))

    def are_near_occupied(
        self, points_world: Points | Points32, *, max_distance_m: float
    ) -> NDArray[np.bool_]:
        """Return the (N,) mask of (N, 3) points, metres, in occupied voxels or near the centre of one."""
        near = self.are_occupied(points_world)
        nearest = self.nearest_obstacles(points_world[~near], max_range_m=max_distance_m)
        near[~near] = np.isfinite(nearest.distances_m)
        return near

    def occupied(self) -> Points:
        """Return the (N, 3) float64 centres of all occupied voxels, metres, in Morton order."""
        parts = [part.centres_world for part in self.leaves_by_part(lowest=self.occupied_log_odds)]
        return np.concatenate([np.empty((0, 3)), *parts])

    def free(self) -> Points:
        """Return the (N, 3) float64 centres of all free voxels, metres, in Morton order."""
        parts = [
            known.centres_world[known.log_odds < self.occupied_log_odds] for known in self.leaves_by_part()
        ]
        return np.concatenate([np.empty((0, 3)), *parts])

    def leaves(self, *, depth: int = KEY_BITS, parent: Parent = "max") -> Leaves:
        """Return every known voxel in Morton order, which does not depend on the order of the scans.

        Args:
            depth: 16, or the depth of the nodes to return instead: see :meth:`log_odds_at`.
            parent: See :meth:`log_odds_at`.

        Raises:
            DataError: No such depth or parent.
        """
        if depth == KEY_BITS:
            return self._known_in(self.blocks.sorted_slots(), lowest=-np.inf)
        codes, values = self._nodes(depth, parent)
        return Leaves(keys_of(codes).astype(np.uint16), values, self.resolution_m, depth)

    def leaves_by_part(
        self, slots: NDArray[np.int64] | None = None, *, lowest: float | np.float32 = -np.inf
    ) -> Iterator[Leaves]:
        """Yield the known voxels some blocks at a time, so that their list need not fit into memory.

        Args:
            slots: (B,) slots of the blocks; None: all, in Morton order.
            lowest: Log-odds below which voxels are left out: ``occupied_log_odds`` yields the occupied ones.
        """
        slots = self.blocks.sorted_slots() if slots is None else slots
        for first in range(0, len(slots), BLOCKS_AT_ONCE):
            yield self._known_in(slots[first : first + BLOCKS_AT_ONCE], lowest=lowest)

    def slice(self, z_min: float, z_max: float | None = None) -> OccupancyGrid:
        """Return the 2D map of the voxels with centres between two heights; occupied beats free.

        Args:
            z_min: Lower height, metres, world frame.
            z_max: Upper height; None: the voxels that ``z_min`` lies in.

        Raises:
            DataError: No voxel, or none that is known, has its centre there.
        """
        from mapper.octree.slice import cut_between

        return cut_between(self, z_min, z_max)

    def cast_rays(
        self,
        origins_world: ArrayLike,
        directions_world: ArrayLike,
        *,
        max_range_m: float = np.inf,
        through_unknown: bool = False,
    ) -> RayEnds:
        """Return the first occupied voxel along N rays, as OctoMap's ``castRay`` finds it.

        Args:
            origins_world: (N, 3) metres, or (3,) of all rays.
            directions_world: (N, 3) of any length but zero, or (3,) of one ray.
            max_range_m: Rays end without a hit once a voxel's centre is further away.
            through_unknown: Pass unknown voxels; otherwise a ray ends, without a hit, in the first.

        Raises:
            DataError: Shapes differ, a direction is zero or not finite, or an origin has no key.
        """
        directions = np.ascontiguousarray(np.atleast_2d(directions_world), dtype=np.float32)
        given_world = np.asarray(origins_world)
        if given_world.shape == (3,):
            given_world = np.broadcast_to(given_world, directions.shape)
        origins = np.ascontiguousarray(given_world, dtype=np.float32)
        expect_shape(origins, "N,3", "octree: origins of rays")
        expect_shape(directions, f"{len(origins)},3", "octree: directions of rays")
        if not np.isfinite(directions).all() or not directions.any(axis=1).all():
            raise DataError("octree: every ray needs a finite direction other than zero")
        for corner in (origins.min(axis=0, initial=0.0), origins.max(axis=0, initial=0.0)):
            origin_key(corner, self.resolution_m)
        keys, hits = kernels.cast_rays(
            self.blocks.table,
            origins,
            directions,
            self.resolution_m,
            max_range_m,
            self.occupied_log_odds,
            through_unknown,
        )
        centres_world = self._centres_of(keys)
        distances_m = np.linalg.norm(centres_world - given_world, axis=1)
        return RayEnds(centres_world, distances_m, hits)

    def nearest_obstacles(self, points_world: ArrayLike, *, max_range_m: float = np.inf) -> Nearest:
        """Return the occupied voxel whose centre is nearest to each point, without a distance field.

        Args:
            points_world: (N, 3) metres, or (3,) of one point, inside the map or not.
            max_range_m: Range of the search; inf searches everywhere.

        Raises:
            DataError: The points are not (N, 3) or not finite, or the range is negative.
        """
        points = np.atleast_2d(np.asarray(points_world, dtype=np.float64))
        expect_shape(points, "N,3", "octree: nearest obstacles of points")
        if not np.isfinite(points).all() or not max_range_m >= 0.0:
            raise DataError(
                f"octree: nearest obstacles within {max_range_m} m, want finite points and a range ≥ 0"
            )
        codes, squares = kernels.find_nearest(
            self.blocks.table,
            self.blocks.codes,
            points / self.resolution_m + (KEY_ZERO - 0.5),
            max_range_m / self.resolution_m,
            self.occupied_log_odds,
        )
        centres_world = self._centres_of(keys_of(codes))
        centres_world[codes < 0] = np.nan
        return Nearest(centres_world, np.sqrt(squares) * self.resolution_m)

    def _centres_of(self, keys: NDArray[np.int64]) -> Points:
        centres_world: Points = (keys.astype(np.float64) - (KEY_ZERO - 0.5)) * self.resolution_m
        return centres_world

    def _known_in(self, slots: NDArray[np.int64], *, lowest: float | np.float32) -> Leaves:
        keys, log_odds = kernels.known_voxels(
            self.blocks.codes[slots], slots, self.blocks.table.values, np.float32(lowest)
        )
        return Leaves(keys, log_odds, self.resolution_m)

    def _nodes(self, depth: int, parent: Parent) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return (M,) Morton codes and (M,) log-odds of the nodes of one depth in which anything is known."""
        if not 0 <= depth <= KEY_BITS:
            raise DataError(f"octree: depth {depth}, want 0 (root) … {KEY_BITS} (voxels)")
        if parent not in ("max", "mean"):
            raise DataError(f"octree: parent {parent!r}, want 'max' or 'mean'")
        slots, mean = self.blocks.sorted_slots(), parent == "mean"
        levels = min(KEY_BITS - depth, BLOCK_BITS)
        found: tuple[NDArray[np.int64], NDArray[np.float32]] = kernels.block_nodes(
            self.blocks.codes[slots], slots, self.blocks.table.values, levels, mean
        )
        for _ in range(depth, BLOCK_DEPTH):
            found = kernels.parents_of(*found, mean)
        return found
