"""Writing of a map in the format that a file's name says."""

from pathlib import Path
from typing import TYPE_CHECKING

from mapper.core.errors import MapFileError
from mapper.octree.map_file import write_map
from mapper.octree.octomap_file import write_bt, write_ot

if TYPE_CHECKING:
    from mapper.octree.map import OctreeMap

_WRITERS = {".octree": write_map, ".ot": write_ot, ".bt": write_bt}


def write_octree(path: Path, octree: "OctreeMap") -> None:
    """Write a map to a file; atomic.

    Args:
        path: ``.octree`` keeps the whole map, OctoMap's ``.ot`` log-odds and colours, and its
            ``.bt`` whether voxels are free or occupied.
        octree: The map.

    Raises:
        MapFileError: Another ending.
        WriteError: The file cannot be written.
    """
    if path.suffix not in _WRITERS:
        raise MapFileError(f"{path}: want a name that ends in {', '.join(_WRITERS)}")
    _WRITERS[path.suffix](path, octree)
