"""The occupancy map: OctoMap's result (Hornung et al. 2013) from sparse blocks and compiled kernels."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapper.core.errors import DataError, MapSizeError
from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array, Points, Transform, apply, point_rows
from mapper.core.paths import AnyPath
from mapper.octree import kernels, levels, queries
from mapper.octree.attributes import NEVER_SEEN, AttributeLayer, ended_blocks
from mapper.octree.blocks import BlockStore
from mapper.octree.boxes import BoxCounts, count_boxes
from mapper.octree.casting import Cast, Caster, depth_limit_of, octree_config
from mapper.octree.config import OctreeConfig, Parent
from mapper.octree.first_obstacles import first_obstacles
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.keys import KEY_BITS, codes_of
from mapper.octree.leaves import Leaves, RayEnds, centres_where, known_leaves
from mapper.octree.nearest import Nearest, nearest_occupied
from mapper.octree.scan_update import ScanUpdate
from mapper.octree.sensor_model import SensorModel, log_odds, sensor_model
from mapper.octree.summing import Overlap, add_blocks
from mapper.octree.tree_reader import TreeLeaves, fill


class OctreeMap:
    """Occupancy octree: log-odds per voxel; an absent voxel is unknown.

    ``OctreeMap(0.1)`` has voxels of 0.1 m and OctoMap's sensor model; :class:`OctreeConfig` has all settings.
    The tree has depth 16; its lowest three levels are stored as dense 8³ blocks. Upper levels are computed
    when a file is written.
    """

    def __init__(self, config: OctreeConfig | float, *, folder: Path | None = None) -> None:
        """Start empty.

        Args:
            config: Settings, or the edge of a voxel.
            folder: Takes a file with the voxels beyond ``config.max_memory_mb``; None keeps all in memory.
        """
        self.config = config = octree_config(config)
        self.blocks = BlockStore(folder=folder, max_memory_bytes=config.max_memory_bytes)
        self.attributes = AttributeLayer(self.blocks, config.resolution_m) if config.attributes else None
        self._caster = Caster(config)
        self._known = 0

    @property
    def resolution_m(self) -> float:
        """Edge of a voxel."""
        return self.config.resolution_m

    def __len__(self) -> int:
        """Return the number of known voxels, all at the finest level."""
        return self._known

    def __repr__(self) -> str:
        occupied = self.count_occupied()
        return (
            f"OctreeMap of {self.resolution_m:g} m voxels: {len(self)} known, "
            f"{occupied} occupied and {len(self) - occupied} free"
        )

    def count_occupied(self) -> int:
        """Return how many of the known voxels are occupied; the others are free."""
        used = self.blocks.table.values[: len(self.blocks.codes)]
        return int(np.count_nonzero(used >= self.occupied_log_odds))

    def write(self, path: AnyPath) -> None:
        """Write the map to a file, as its ending says; see :func:`~mapper.octree.writing.write_octree`."""
        from mapper.octree.writing import write_octree

        write_octree(Path(path), self)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the map itself, spare capacity included, without the scan window."""
        return self.blocks.memory_bytes + (self.attributes.memory_bytes if self.attributes else 0)

    @property
    def working_bytes(self) -> int:
        """Bytes of address space of the scan window; only pages that rays crossed are backed by memory."""
        return self._caster.memory_bytes

    def insert(self, scan: Scan, T_world_body: Transform) -> None:
        """Fuse one scan: a miss along every ray, a hit at its end; each voxel changes once, and a hit wins.

        Raises:
            DataError: A point or the origin has no key.
            MapSizeError: The scan or the map would be too large; the map has not changed then.
        """
        self._merge(self._caster.cast(scan, T_world_body))
        if self.attributes is not None:
            if (limit := depth_limit_of(self.config)) is not None:
                scan, _ = limit.split(scan)
            self.attributes.add(
                scan.points_body,
                T_world_body,
                origin_world=apply(T_world_body, scan.origin_body[np.newaxis])[0],
                config=self.config,
                colors=scan.colors,
                stamp_ns=scan.stamp_ns,
            )

    def insert_points(self, points_world: Points32, origin_world: Array) -> None:
        """Fuse world points as OctoMap's ``insertPointCloud`` does.

        Args:
            points_world: (N, 3) float32 metres.
            origin_world: (3,) where the rays start, metres.

        Raises:
            DataError: The points are not (N, 3), or one of them or the origin has no key.
            MapSizeError: The scan or the map would be too large; the map has not changed then.
        """
        self._merge(self._caster.cast_points(points_world, origin_world))
        if self.attributes is not None:
            self.attributes.add(
                points_world,
                np.eye(4),
                origin_world=origin_world,
                config=self.config,
                colors=None,
                stamp_ns=NEVER_SEEN,
            )

    def merge(self, update: ScanUpdate) -> None:
        """Fuse a scan's update: the same as inserting the scan, to the last bit, but without attributes.

        Raises:
            MapSizeError: The map would be too large; it has not changed then.
        """
        slots = self.blocks.claim(update.codes)
        self._add(update.cells(), np.arange(len(update)), slots)

    def _merge(self, cast: Cast) -> None:
        try:
            slots = self.blocks.claim(cast.codes)
            if self.attributes is not None:
                self.attributes.claim(slots[ended_blocks(cast.window.cells, cast.positions)])
        except MapSizeError:
            self._caster.reset()
            raise
        self._add(cast.window.cells, cast.positions, slots)

    def _add(self, cells: NDArray[np.uint8], positions: NDArray[np.int64], slots: NDArray[np.int64]) -> None:
        self._known += kernels.merge(cells, positions, slots, self.blocks.table.values, self.sensor)

    @property
    def sensor(self) -> SensorModel:
        """The sensor model in log-odds."""
        return sensor_model(self.config)

    @property
    def occupied_log_odds(self) -> np.float32:
        """Least log-odds of an occupied voxel."""
        return log_odds(self.config.occupied_probability)

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
        if depth != KEY_BITS:
            found = levels.values_at_depth(
                self.blocks, rows, resolution_m=self.resolution_m, depth=depth, parent=parent
            )
        else:
            found = queries.values_at(self.blocks.table, rows, self.resolution_m)
        return found.reshape(shape)

    def occupied(self) -> Points:
        """Return the (N, 3) float64 centres of all occupied voxels, metres, in Morton order."""
        return centres_where(self.blocks, self.resolution_m, lambda odds: odds >= self.occupied_log_odds)

    def free(self) -> Points:
        """Return the (N, 3) float64 centres of all free voxels, metres, in Morton order."""
        return centres_where(self.blocks, self.resolution_m, lambda odds: odds < self.occupied_log_odds)

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

    def are_occupied(self, points_world: Points | Points32) -> NDArray[np.bool_]:
        """Return the (N,) mask of the (N, 3) points, metres, that lie in occupied voxels."""
        return self.log_odds_at(points_world) >= self.occupied_log_odds

    def are_near_occupied(
        self, points_world: Points | Points32, *, max_distance_m: float
    ) -> NDArray[np.bool_]:
        """Return the (N,) mask of (N, 3) points, metres, in occupied voxels or near the centre of one."""
        near = self.are_occupied(points_world)
        nearest = self.nearest_obstacles(points_world[~near].astype(np.float64), max_range_m=max_distance_m)
        near[~near] = np.isfinite(nearest.distances_m)
        return near

    def cast_rays(
        self, origins_world: Points, directions_world: Points, *, max_range_m: float, through_unknown: bool
    ) -> RayEnds:
        """Return the first occupied voxel along N rays, as OctoMap's ``castRay`` finds it.

        Args:
            origins_world: (N, 3) metres.
            directions_world: (N, 3) of any length but zero.
            max_range_m: Rays end without a hit once a voxel's centre is further away.
            through_unknown: Pass unknown voxels; otherwise a ray ends, without a hit, in the first.

        Raises:
            DataError: Shapes differ, a direction is zero or not finite, or an origin has no key.
        """
        return first_obstacles(
            self.blocks,
            origins_world,
            directions_world,
            resolution_m=self.resolution_m,
            threshold=self.occupied_log_odds,
            max_range_m=max_range_m,
            through_unknown=through_unknown,
        )

    def count_boxes(self, lower_world: Points, upper_world: Points) -> BoxCounts:
        """Count the voxels in N boxes between (N, 3) corners, metres; see :mod:`mapper.octree.boxes`."""
        return count_boxes(
            self.blocks,
            lower_world,
            upper_world,
            resolution_m=self.resolution_m,
            threshold=self.occupied_log_odds,
        )

    def nearest_obstacles(self, points_world: Points, *, max_range_m: float) -> Nearest:
        """Return the obstacle nearest to each of (N, 3) points; see :mod:`mapper.octree.nearest`."""
        return nearest_occupied(
            self.blocks,
            points_world,
            resolution_m=self.resolution_m,
            max_range_m=max_range_m,
            threshold=self.occupied_log_odds,
        )

    def restore(self, leaves: TreeLeaves) -> None:
        """Fill an empty map with the leaves of a file.

        Raises:
            DataError: The map already has voxels.
            MapSizeError: Expanded to voxels, the leaves would not fit into memory.
        """
        if self._known:
            raise DataError(f"octree: holds {self._known} voxels already; restore into a new map")
        self._known = fill(self.blocks, leaves)

    def restore_blocks(
        self, codes: NDArray[np.int64], known: NDArray[np.bool_], values: NDArray[np.float32]
    ) -> None:
        """Fill an empty map with whole blocks.

        Args:
            codes: (B,) distinct Morton codes of the blocks.
            known: (B, 512) mask of their known voxels.
            values: (K,) log-odds of the known voxels, block after block.

        Raises:
            MapSizeError: The blocks would not fit into memory.
        """
        slots = self.blocks.claim(codes)
        blocks, voxels = np.nonzero(known)
        self.blocks.table.values[slots[blocks], voxels] = values
        self._known = len(values)

    def add(self, other: "OctreeMap", *, slots: NDArray[np.int64] | None = None) -> Overlap:
        """Add the log-odds of an independent map voxel by voxel: Bayes' rule with a prior of 0.5.

        Attributes are added as well if this map has any. Log-odds may leave the sensor model's limits; call
        ``clamp`` after the last map.

        Args:
            other: A map of the same resolution; with attributes if this one has them.
            slots: Slots of the other map's blocks that are added; None adds all.

        Raises:
            MapSizeError: The map would be too large; it has not changed then.
        """
        slots = other.blocks.sorted_slots() if slots is None else slots
        own = self.blocks.claim(other.blocks.codes[slots])
        if self.attributes is not None and other.attributes is not None:
            self.attributes.add_layer(other.attributes, slots, own)
        added, overlap = add_blocks(
            self.blocks.table.values, own, other.blocks.table.values, slots, self.occupied_log_odds
        )
        self._known += added
        return Overlap(*overlap)

    def coarser(self, levels: int, *, parent: Parent = "mean") -> "OctreeMap":
        """Return the map of the nodes some levels above the voxels, as voxels 2**levels times as wide.

        It has no attributes.

        Args:
            levels: 0 … 16.
            parent: See :meth:`log_odds_at`.

        Raises:
            DataError: No such level or parent.
        """
        nodes = self.leaves(depth=KEY_BITS - levels, parent=parent)
        update = {"resolution_m": nodes.edge_m, "attributes": False}
        coarse = OctreeMap(self.config.model_copy(update=update))
        depths = np.full(len(nodes.log_odds), KEY_BITS, np.uint8)
        codes = codes_of(nodes.centres_world, nodes.edge_m)
        coarse.restore(TreeLeaves(codes, depths, nodes.log_odds))
        return coarse

    def lower_known(self, voxels: int) -> None:
        """Reduce the number of known voxels, after the log-odds of some were set to NaN."""
        self._known -= voxels

    def set_free(self, slots: NDArray[np.int64], voxels: NDArray[np.bool_]) -> int:
        """Make occupied voxels free, at the sensor model's least log-odds; return how many there were.

        Args:
            slots: (B,) distinct slots of blocks.
            voxels: (B, 512) mask of their voxels, in Morton order.
        """
        values = self.blocks.table.values[slots]
        occupied = voxels & (values >= self.occupied_log_odds)
        values[occupied] = self.sensor.lowest
        self.blocks.table.values[slots] = values
        return int(np.count_nonzero(occupied))

    def set_unknown(self, slots: NDArray[np.int64], voxels: NDArray[np.bool_]) -> int:
        """Make voxels unknown, as :meth:`set_free` makes them free; call ``drop_unknown`` after the last."""
        values = self.blocks.table.values[slots]
        known = voxels & ~np.isnan(values)
        values[known] = np.nan
        self.blocks.table.values[slots] = values
        count = int(np.count_nonzero(known))
        self.lower_known(count)
        return count

    def drop_unknown(self) -> None:
        """Remove what is left of voxels that were made unknown: their attributes, and blocks without others.

        Files have no node for such a block, and cannot be written before.
        """
        if self.attributes is not None:
            self.attributes.clear_unknown()
        kept = self.blocks.drop_unknown()
        if self.attributes is not None:
            self.attributes.renumber(kept)

    def clamp(self) -> None:
        """Clip all log-odds to the sensor model's limits."""
        sensor = self.sensor
        values = self.blocks.table.values[: len(self.blocks)]
        np.clip(values, sensor.lowest, sensor.highest, out=values)

    def leaves(self, *, depth: int = KEY_BITS, parent: Parent = "max") -> Leaves:
        """Return every known voxel in Morton order, which does not depend on the order of the scans.

        Args:
            depth: 16, or the depth of the nodes to return instead: see :meth:`log_odds_at`.
            parent: See :meth:`log_odds_at`.

        Raises:
            DataError: No such depth or parent.
        """
        if depth != KEY_BITS:
            codes, node_values = levels.nodes_at(self.blocks, depth=depth, parent=parent)
            return Leaves(levels.keys_at_depth(codes), node_values, self.resolution_m, depth)
        return known_leaves(self.blocks, self.blocks.sorted_slots(), self.resolution_m)
