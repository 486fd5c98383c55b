"""Octree maps by name."""

from pathlib import Path

from mapper.octree import map as octree_map
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.run import files
from mapper.run.folder import open_run
from mapper.runtime.regular_files import AnyPath


def read_octree(path: AnyPath, config: OctreeConfig | None = None) -> OctreeMap:
    """Return the map of a run, or of a ``.bt``, ``.ot`` or ``.octree`` file.

    Leaves of a ``.bt`` file take the clamping values of the sensor model. A file with colours makes a map
    with attributes. The kind of file follows from its first bytes, not from its name.

    Args:
        path: Run folder, or the file.
        config: Sensor model for scans inserted later; None takes that of an ``.octree`` file, or OctoMap's
            defaults. The resolution is always the file's.

    Raises:
        RunError: The folder is not a run, or its map is not as it was written.
        MapFileError: The file cannot be read, is truncated, foreign or damaged.
        MapSizeError: Its leaves, expanded to voxels, would not fit into memory.
    """
    path = Path(path)
    if path.is_dir():
        path = open_run(path).file(files.OCTREE_MAP)
    return octree_map.read_octree(path, config)
