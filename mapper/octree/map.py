"""The occupancy map: OctoMap's result (Hornung et al. 2013) from sparse blocks and compiled kernels."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from mapper.core.errors import DataError, MapFileError, MapSizeError
from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array, Transform, apply
from mapper.octree import map_file, octomap_file, ray_casting_kernels
from mapper.octree.attributes import NEVER_SEEN, UNSET, AttributeLayer, ended_blocks
from mapper.octree.config import OctreeConfig, Parent
from mapper.octree.keys import KEY_BITS, codes_of
from mapper.octree.octomap_file import TreeLeaves, fill
from mapper.octree.queries import MapView
from mapper.octree.ray_casting import Caster, depth_limit_of
from mapper.octree.scan_updates import ScanUpdate
from mapper.octree.sparse_grid import BlockStore, Overlap, SensorModel, add_blocks, check_memory, sensor_model
from mapper.runtime.regular_files import AnyPath, read_regular


class OctreeMap(MapView):
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

        Raises:
            DataError: The edge is no positive number.
        """
        if not isinstance(config, OctreeConfig):
            try:
                config = OctreeConfig(resolution_m=config)
            except ValidationError:
                raise DataError(
                    f"octree: voxels of {config!r} m; want metres > 0, or an OctreeConfig"
                ) from None
        self.config = config
        self.blocks = BlockStore(folder=folder, max_memory_bytes=config.max_memory_bytes)
        self.attributes = AttributeLayer(self.blocks, config.resolution_m) if config.attributes else None
        self._caster = Caster(config)

    @property
    def sensor(self) -> SensorModel:
        """The sensor model in log-odds."""
        return sensor_model(self.config)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the map itself, without the scan window."""
        return self.blocks.memory_bytes + (self.attributes.memory_bytes if self.attributes else 0)

    def write(self, path: AnyPath) -> None:
        """Write the map to a file; atomic.

        Args:
            path: ``.octree`` keeps the whole map, OctoMap's ``.ot`` log-odds and colours, and its ``.bt``
                whether voxels are free or occupied.

        Raises:
            MapFileError: Another ending.
            WriteError: The file cannot be written.
        """
        path = Path(path)
        writers = {
            ".octree": map_file.write_map,
            ".ot": octomap_file.write_ot,
            ".bt": octomap_file.write_bt,
        }
        if path.suffix not in writers:
            raise MapFileError(f"{path}: want a name that ends in {', '.join(writers)}")
        writers[path.suffix](path, self)

    def insert(self, scan: Scan, T_world_body: Transform, caster: Caster | None = None) -> None:
        """Fuse one scan: a miss along every ray, a hit at its end; each voxel changes once, and a hit wins.

        Args:
            scan: The scan.
            T_world_body: (4, 4) its pose.
            caster: Caster of its rays, where these have limits of their own; None is that of the map.

        Raises:
            DataError: A point or the origin has no key.
            MapSizeError: The scan or the map would be too large; the map has not changed then.
        """
        caster = self._caster if caster is None else caster
        cast = caster.cast(scan, T_world_body)
        try:
            slots = self.blocks.claim(cast.codes)
            if self.attributes is not None:
                self.attributes.claim(slots[ended_blocks(cast.window.cells, cast.positions)])
        except MapSizeError:
            caster.reset()
            raise
        ray_casting_kernels.merge(
            cast.window.cells, cast.positions, slots, self.blocks.table.values, self.sensor
        )
        if self.attributes is not None:
            if (limit := depth_limit_of(caster.config)) is not None:
                scan, _ = limit.split(scan)
            self.attributes.add(
                scan.points_body,
                T_world_body,
                origin_world=apply(T_world_body, scan.origin_body[np.newaxis])[0],
                config=caster.config,
                colors=scan.colors,
                stamp_ns=scan.stamp_ns,
            )

    def insert_points(self, points_world: Points32, origin_world: Array) -> None:
        """Fuse world points as OctoMap's ``insertPointCloud`` does.

        Args:
            points_world: (N, 3) metres; computed in float32.
            origin_world: (3,) where the rays start, metres.

        Raises:
            DataError: The points are not (N, 3), or one of them or the origin has no key.
            MapSizeError: The scan or the map would be too large; the map has not changed then.
        """
        scan = Scan(NEVER_SEEN, np.asarray(points_world, np.float32), np.asarray(origin_world, np.float64))
        self.insert(scan, np.eye(4))

    def merge(self, update: ScanUpdate) -> None:
        """Fuse a scan's update: the same as inserting the scan, to the last bit, but without attributes.

        Raises:
            MapSizeError: The map would be too large; it has not changed then.
        """
        slots = self.blocks.claim(update.codes)
        positions = np.arange(len(update))
        ray_casting_kernels.merge(update.cells(), positions, slots, self.blocks.table.values, self.sensor)

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
        values, others = self.blocks.table.values, other.blocks.table.values
        return Overlap(*add_blocks(values, own, others, slots, self.occupied_log_odds))

    def clamp(self) -> None:
        """Clip all log-odds to the sensor model's limits."""
        values = self.blocks.table.values[: len(self.blocks)]
        np.clip(values, self.sensor.lowest, self.sensor.highest, out=values)

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

    def set_unknown(self, slots: NDArray[np.int64], voxels: NDArray[np.bool_]) -> None:
        """Make voxels unknown, given as in :meth:`set_free`; call ``drop_unknown`` after the last."""
        values = self.blocks.table.values[slots]
        values[voxels] = np.nan
        self.blocks.table.values[slots] = values

    def drop_unknown(self) -> None:
        """Remove what is left of voxels that were made unknown: their attributes, and blocks without others.

        Files have no node for such a block, and cannot be written before.
        """
        if self.attributes is not None:
            self.attributes.clear_unknown()
        kept = self.blocks.drop_unknown()
        if self.attributes is not None:
            self.attributes.renumber(kept)

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

    def restore(self, leaves: TreeLeaves) -> None:
        """Fill an empty map with the leaves of a file.

        Raises:
            DataError: The map already has voxels.
            MapSizeError: Expanded to voxels, the leaves would not fit into memory.
        """
        if len(self.blocks):
            raise DataError(f"octree: holds {len(self)} voxels already; restore into a new map")
        fill(self.blocks, leaves)

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


def read_octree(path: AnyPath, config: OctreeConfig | None = None) -> OctreeMap:
    """Return the map of a ``.bt`` or ``.ot`` file of an OcTree or a ColorOcTree, or of an ``.octree`` file.

    Leaves of a ``.bt`` file take the clamping values of the sensor model. A file with colours makes a map
    with attributes. The kind of file follows from its first bytes, not from its name.

    Args:
        path: The file.
        config: Sensor model for scans inserted later; None takes that of an ``.octree`` file, or OctoMap's
            defaults. The resolution is always the file's.

    Raises:
        MapFileError: The file cannot be read, is truncated, foreign or damaged.
        MapSizeError: Its leaves, expanded to voxels, would not fit into memory.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        check_memory(size, f"the map in {path}")
        data = read_regular(path, most_bytes=size)
        if data.startswith(map_file.MAGIC):
            return _from_map_file(path, data, config)
        return _from_octomap(path, data, config or OctreeConfig())
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read: {error.strerror}") from None
    except DataError as error:
        raise MapFileError(f"{path}: {error}") from None
    except MemoryError:
        raise MapSizeError(f"{path}: does not fit into memory") from None


def _from_octomap(path: Path, data: bytes, config: OctreeConfig) -> OctreeMap:
    tree = octomap_file.parse_tree(path, data, sensor_model(config))
    changes: dict[str, object] = {"resolution_m": tree.resolution_m}
    if tree.colors is not None and (tree.colors != UNSET).any():
        changes["attributes"] = True
    octree = OctreeMap(config.model_copy(update=changes))
    if tree.leaves is not None:
        octree.restore(tree.leaves)
        if tree.colors is not None and octree.attributes is not None:
            octree.attributes.restore_colors(tree.leaves.codes, tree.leaves.depths, tree.colors)
    return octree


def _from_map_file(path: Path, data: bytes, config: OctreeConfig | None) -> OctreeMap:
    stored, columns = map_file.parse_map(path, data)
    if config is None:
        config = stored
    else:
        kept = {"resolution_m": stored.resolution_m, "attributes": stored.attributes}
        config = config.model_copy(update=kept)
    octree = OctreeMap(config)
    octree.restore_blocks(*map_file.voxels_of(path, columns))
    if octree.attributes is not None:
        map_file.restore_attributes(path, columns, octree.blocks, octree.attributes)
    return octree
