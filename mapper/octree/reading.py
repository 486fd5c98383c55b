"""Reading of maps: OctoMap's ``.bt`` and ``.ot`` files, and ``.octree`` files."""

from pathlib import Path

from mapper.core.errors import DataError, MapFileError, MapSizeError
from mapper.core.paths import AnyPath
from mapper.octree import map_file
from mapper.octree.attributes import UNSET
from mapper.octree.blocks import check_memory
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.octree.octomap_file import parse_tree
from mapper.octree.sensor_model import sensor_model
from mapper.runtime.regular_files import read_regular


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
    tree = parse_tree(path, data, sensor_model(config))
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
