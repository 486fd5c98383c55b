"""The occupancy map: OctoMap's result (Hornung et al. 2013) from sparse blocks and compiled kernels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.config.octree import OctreeConfig
from mapper.errors import DataError, MapSizeError
from mapper.frames import Points32, Scan
from mapper.geometry import Array, Points, Transform, apply
from mapper.octree import kernels, queries
from mapper.octree.blocks import BlockStore
from mapper.octree.keys import KEY_COUNT, KEY_ZERO
from mapper.octree.tree_reader import TreeLeaves, fill
from mapper.octree.window import WindowBuffer, block_codes, take_touched


@dataclass(frozen=True, slots=True, eq=False)
class Leaves:
    """Known voxels at the finest level, in Morton order.

    Attributes:
        keys: (N, 3) uint16, OctoMap's.
        log_odds: (N,) float32.
        resolution_m: Edge of a voxel.
    """

    keys: NDArray[np.uint16]
    log_odds: NDArray[np.float32]
    resolution_m: float

    @property
    def centres_world(self) -> Points:
        """(N, 3) float64 voxel centres, metres."""
        return (self.keys.astype(np.float64) - (KEY_ZERO - 0.5)) * self.resolution_m


@dataclass(frozen=True, slots=True, eq=False)
class RayEnds:
    """Where rays through the map ended.

    Attributes:
        centres_world: (N, 3) float64 centre of the last voxel, metres.
        distances_m: (N,) float64 from the ray's origin to that centre.
        hits: (N,) bool, whether that voxel is occupied.
    """

    centres_world: Points
    distances_m: Array
    hits: NDArray[np.bool_]


class OctreeMap:
    """Log-odds per voxel; an absent voxel is unknown.

    The map is an octree of depth 16 whose lowest three levels are stored as dense 8³ blocks. Upper levels are
    implied, and computed when a file is written.
    """

    def __init__(self, config: OctreeConfig) -> None:
        self.config = config
        self.blocks = BlockStore()
        self._window = WindowBuffer()
        self._known = 0

    @property
    def resolution_m(self) -> float:
        """Edge of a voxel."""
        return self.config.resolution_m

    def __len__(self) -> int:
        """Return how many voxels are known, all at the finest level."""
        return self._known

    @property
    def memory_bytes(self) -> int:
        """Bytes of the map itself, spare capacity included, without the scan window."""
        return self.blocks.memory_bytes

    @property
    def working_bytes(self) -> int:
        """Bytes of address space of the scan window; only what rays have crossed is backed by memory."""
        return self._window.memory_bytes

    def insert(self, scan: Scan, T_world_body: Transform) -> None:
        """Fuse one scan: a miss along every ray, a hit at its end; each voxel changes once, and a hit wins.

        Raises:
            DataError: A point or the origin has no key.
            MapSizeError: The scan or the map would be too large; the map has not changed then.
        """
        origin_world = apply(T_world_body, scan.origin_body[np.newaxis])[0]
        points_body = np.ascontiguousarray(scan.points_body)
        if self.config.discretize:
            self._insert_discretized(points_body, T_world_body, origin_world)
        else:
            self._insert_rays(kernels.to_world(points_body, np.ascontiguousarray(T_world_body)), origin_world)

    def insert_points(self, points_world: Points32, origin_world: Array) -> None:
        """Fuse world points as OctoMap's ``insertPointCloud`` does.

        Args:
            points_world: (N, 3) float32 metres.
            origin_world: (3,) where the rays start, metres.

        Raises:
            DataError: The points are not (N, 3), or one of them or the origin has no key.
            MapSizeError: The scan or the map would be too large; the map has not changed then.
        """
        if points_world.ndim != 2 or points_world.shape[1] != 3:
            raise DataError(f"octree: points {points_world.shape}, want (N, 3)")
        points_world = np.ascontiguousarray(points_world, dtype=np.float32)
        if self.config.discretize:
            self._insert_discretized(points_world, np.eye(4), origin_world)
        else:
            self._insert_rays(points_world, origin_world)

    def _insert_discretized(
        self, points_body: Points32, T_world_body: Transform, origin_world: Array
    ) -> None:
        centres_world, outside = kernels.end_voxels(
            points_body, np.ascontiguousarray(T_world_body), self.resolution_m
        )
        self._refuse(outside, len(points_body))
        self._insert_rays(centres_world, origin_world)

    def _insert_rays(self, ends_world: Points32, origin_world: Array) -> None:
        origin = np.asarray(origin_world, dtype=np.float32)
        origin_key = self._origin_key(origin)
        stops, hits, lowest, highest, outside = kernels.clip_rays(
            ends_world, origin, self.resolution_m, self.config.max_range_m
        )
        self._refuse(outside, len(ends_world))
        window = self._window.place(lowest, highest, origin=origin_key)
        kernels.cast_rays(stops, hits, origin, self.resolution_m, window)
        positions = take_touched(window)
        try:
            slots = self.blocks.claim(block_codes(window, positions, lowest))
        except MapSizeError:
            self._window = WindowBuffer()  # the old one still holds this scan
            raise
        self._known += kernels.merge(window, positions, slots, self.blocks.table.values, self._sensor())

    def _sensor(self) -> kernels.Sensor:
        config = self.config
        return kernels.Sensor(
            hit=log_odds(config.hit_probability),
            miss=log_odds(config.miss_probability),
            lowest=log_odds(config.clamp_min_probability),
            highest=log_odds(config.clamp_max_probability),
        )

    @property
    def occupied_log_odds(self) -> np.float32:
        """Log-odds from which a voxel counts as occupied."""
        return log_odds(self.config.occupied_probability)

    @property
    def _reach_m(self) -> float:
        return KEY_ZERO * self.resolution_m

    def _origin_key(self, origin: NDArray[np.float32]) -> NDArray[np.int64]:
        keys = np.floor((1.0 / self.resolution_m) * origin.astype(np.float64)) + KEY_ZERO
        if not ((keys >= 0) & (keys < KEY_COUNT)).all():
            raise DataError(
                f"octree: sensor origin {origin.tolist()} is not within ±{self._reach_m:g} m, the reach of "
                f"{self.resolution_m:g} m voxels; raise resolution_m or shift the map"
            )
        return keys.astype(np.int64)

    def _refuse(self, outside: int, total: int) -> None:
        if outside:
            raise DataError(
                f"octree: {outside} of {total} points are not finite or not within ±{self._reach_m:g} m, the "
                f"reach of {self.resolution_m:g} m voxels; drop them or raise resolution_m"
            )

    def query(self, points_world: Points) -> NDArray[np.float32]:
        """Return the (N,) log-odds of (N, 3) points in metres; NaN where nothing is known or can be."""
        points_world = np.ascontiguousarray(points_world, dtype=np.float64)
        found: NDArray[np.float32] = queries.values_at(self.blocks.table, points_world, self.resolution_m)
        return found

    def cast_rays(
        self, origins_world: Points, directions_world: Points, *, max_range_m: float, through_unknown: bool
    ) -> RayEnds:
        """Return where rays first meet an occupied voxel, as OctoMap's ``castRay`` does.

        Args:
            origins_world: (N, 3) metres.
            directions_world: (N, 3) of any length but zero.
            max_range_m: Rays end without a hit once a voxel's centre is further away.
            through_unknown: Go on through unknown voxels; otherwise a ray ends, without a hit, in the first.

        Raises:
            DataError: Shapes differ, a direction is zero or not finite, or an origin has no key.
        """
        origins = np.ascontiguousarray(origins_world, dtype=np.float32)
        directions = np.ascontiguousarray(directions_world, dtype=np.float32)
        if origins.shape != directions.shape or origins.ndim != 2 or origins.shape[1] != 3:
            raise DataError(f"octree: rays from {origins.shape} along {directions.shape}, want two (N, 3)")
        if not np.isfinite(directions).all() or not directions.any(axis=1).all():
            raise DataError("octree: every ray needs a finite direction other than zero")
        for corner in (origins.min(axis=0, initial=0.0), origins.max(axis=0, initial=0.0)):
            self._origin_key(corner)
        keys, outcomes = queries.first_obstacles(
            self.blocks.table,
            origins,
            directions,
            self.resolution_m,
            max_range_m,
            self.occupied_log_odds,
            through_unknown,
        )
        centres_world = (keys - (KEY_ZERO - 0.5)) * self.resolution_m
        distances_m = np.linalg.norm(centres_world - origins_world, axis=1)
        return RayEnds(centres_world, distances_m, outcomes == queries.HIT)

    def restore(self, leaves: TreeLeaves) -> None:
        """Take over the leaves of a file; the map must be empty.

        Raises:
            DataError: The map already holds voxels.
            MapSizeError: Expanded to voxels, the leaves would not fit into memory.
        """
        if self._known:
            raise DataError(f"octree: holds {self._known} voxels already; restore into a new map")
        self._known = fill(self.blocks, leaves)

    def leaves(self) -> Leaves:
        """Return every known voxel, in Morton order: the order does not depend on that of the scans."""
        slots = self.blocks.sorted_slots()
        keys, values = queries.known_voxels(
            self.blocks.codes[slots], slots, self.blocks.table.values, self._known
        )
        return Leaves(keys, values, self.resolution_m)


def log_odds(probability: float) -> np.float32:
    """Return ln(p / (1 − p)) rounded to float32, as OctoMap stores it."""
    return np.float32(np.log(probability / (1.0 - probability)))
