"""Floor of a merged map, found over all its tiles from where all its runs drove; and that of any map."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Points, apply, inverse
from mapper.export.run_maps import editor_of, floor_of_run
from mapper.mapping.config import Edits
from mapper.mapping.edits import MapEditor
from mapper.merging.merged_map import MapManifest, MergedMap
from mapper.navigation.config import TraversableConfig
from mapper.navigation.floor import Floor, floor_of, margin_for
from mapper.navigation.traversable import TraversableFloor, traversable
from mapper.octree.columns import block_extent, columns_of, occupied_voxels
from mapper.octree.map import read_octree
from mapper.run.folder import Run

MOST_COLUMNS = 1 << 25
"""More columns in the map's bounding box, and its floor would take more than about 2 GB."""

Extent = tuple[NDArray[np.int64], NDArray[np.int64]]
"""x and y keys of the first column of any block, and those after the last."""


def floor_over(
    voxels: Iterable[NDArray[np.int64]],
    extent: Extent,
    config: TraversableConfig,
    *,
    paths_map: Sequence[Points],
    resolution_m: float,
    floor_z_m: float,
) -> Floor:
    """Return the floor of a map whose occupied voxels are given tile by tile; see ``floor_of``.

    Args:
        voxels: Voxels of each tile, from ``occupied_voxels``.
        extent: Extent of all tiles' blocks, from ``block_extent``.
        config: Limits of the robot.
        paths_map: (N, 3) positions of the sensor in every run, metres, the map's frame.
        resolution_m: Edge of a voxel.
        floor_z_m: Height of the floor in the map.
    """
    columns = columns_of(
        np.concatenate([np.empty(0, np.int64), *voxels]),
        extent,
        margin=margin_for(config, resolution_m),
        resolution_m=resolution_m,
    )
    return floor_of(columns, config, paths_world=paths_map, floor_z_m=floor_z_m)


def floor_of_map(merged: MergedMap) -> TraversableFloor:
    """Return a merged map's floor with its links, found again from its tiles and its runs' paths.

    Raises:
        MapFileError: A tile cannot be read.
        RunError: A run's trajectory is missing.
    """
    manifest = merged.manifest
    paths_map = _paths(merged)
    voxels, extents = [], []
    for tile in manifest.tiles:
        octree = read_octree(merged.tile_path(tile))
        voxels.append(occupied_voxels(octree))
        extents.append(block_extent(octree))
    firsts, lasts = zip(*extents, strict=True)
    floor = floor_over(
        voxels,
        (np.min(firsts, axis=0), np.max(lasts, axis=0)),
        manifest.traversable,
        paths_map=paths_map,
        resolution_m=manifest.octree.resolution_m,
        floor_z_m=manifest.floor_z_m,
    )
    return with_keepout(
        traversable(floor, manifest.traversable, with_links=True), editors_of(manifest, paths_map)
    )


def editors_of_map(merged: MergedMap) -> list[MapEditor]:
    """Return an editor for each run of a merged map that has keep-out regions.

    Raises:
        RunError: A run's trajectory is missing.
    """
    if not any(run.keepout for run in merged.manifest.runs):
        return []
    return editors_of(merged.manifest, _paths(merged))


def _paths(merged: MergedMap) -> list[Points]:
    return [merged.trajectory(run).positions_world for run in merged.manifest.runs]


def editors_of(manifest: MapManifest, paths_map: Sequence[Points]) -> list[MapEditor]:
    """Return an editor for each run of a map that has keep-out regions.

    Args:
        manifest: The map's.
        paths_map: (N, 3) positions of the sensor in every run, metres, the map's frame.
    """
    editors = []
    for run, path_map in zip(manifest.runs, paths_map, strict=True):
        if run.keepout:
            T_world_map = inverse(np.array(run.T_map_world))
            path_world = apply(T_world_map, path_map)
            room_m = manifest.traversable.head_room_m
            editors.append(MapEditor(Edits(keepout=run.keepout), path_world, room_m, T_world_map))
    return editors


def with_keepout(floor: TraversableFloor, editors: Sequence[MapEditor]) -> TraversableFloor:
    """Return a floor with the runs' keep-out regions blocked."""
    for editor in editors:
        floor, _ = editor.edit_floor(floor)
    return floor


def traversable_of(folder: Run | MergedMap) -> TraversableFloor:
    """Return the floor of a run or of a merged map, as ``floor_of_map`` does.

    Raises:
        MapFileError: The octree, or a tile, cannot be read.
        RunError: A merged run's trajectory is missing.
    """
    return floor_of_run(folder) if isinstance(folder, Run) else floor_of_map(folder)


def keep_out_of(folder: Run | MergedMap) -> Callable[[Points], NDArray[np.bool_]] | None:
    """Return the function that marks points in keep-out regions; None if there are no regions.

    Raises:
        RunError: A merged run's trajectory is missing.
    """
    editors = [editor_of(folder)] if isinstance(folder, Run) else editors_of_map(folder)
    if not any(editor.edits.keepout for editor in editors):
        return None
    return lambda points: np.any([editor.keep_out(points) for editor in editors], axis=0)
