"""Floor, slice and picture of a merged map, over all its tiles and below the paths of all its runs."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Points, apply, inverse
from mapper.export.run_maps import editor_of, floor_of_run
from mapper.mapping.config import Edits
from mapper.mapping.edits import MapEditor
from mapper.merging.jobs import (
    BAND,
    GROUND,
    LOWEST,
    OCCUPIED,
    JoinedTile,
    SlicedColumn,
    Workspace,
    save_array,
    slice_column,
)
from mapper.merging.merged_map import MapManifest, MergedMap
from mapper.merging.world_poses import Placed
from mapper.navigation.config import TraversableConfig
from mapper.navigation.reachable_floor import Floor, driven_ground, floor_of, margin_for
from mapper.navigation.traversable_grid import TraversableFloor, traversable
from mapper.octree.grid import OccupancyGrid, overlap_of, with_obstacles
from mapper.octree.map import read_octree
from mapper.octree.occupied_columns import (
    NOTHING,
    DrivenGround,
    block_extent,
    columns_of,
    ground_from_lowest,
    known_floor,
    nearest_heights,
    occupied_voxels,
    snap_to_floor,
)
from mapper.octree.slice import Band
from mapper.run.folder import Run
from mapper.runtime.resumable_jobs import Stages

_MAX_TILT_RAD = np.deg2rad(5.0)
MOST_COLUMNS = 1 << 25
"""More columns in the map's bounding box, and its floor would take more than about 2 GB."""

Extent = tuple[NDArray[np.int64], NDArray[np.int64]]
"""x and y keys of the first column of any block, and those after the last."""


@dataclass(frozen=True, slots=True, eq=False)
class Sliced:
    """Grids of a merged map.

    Attributes:
        columns: Results of all columns of tiles.
        grid: The slice; None if there is none.
        keepout: The runs' keep-out regions in its cells; None if there are none.
        floor: Traversable floor; None if there is none.
        no_floor: Why there is no floor; empty if there is one.
        no_slice: Why there is no slice, if that is not the same reason.
    """

    columns: Sequence[SlicedColumn]
    grid: OccupancyGrid | None
    keepout: OccupancyGrid | None
    floor: TraversableFloor | None
    no_floor: str
    no_slice: str = ""


def slice_map(
    workspace: Workspace,
    stages: Stages,
    joined: Mapping[int, JoinedTile],
    manifest: MapManifest,
    placed: Sequence[Placed],
) -> Sliced:
    """Find the floor under the runs' paths, and cut the slice above it.

    Args:
        workspace: Workspace with the tiles and their pieces.
        stages: Runs the jobs, one for each column of tiles.
        joined: The tiles.
        manifest: Manifest of the map, without what is found here.
        placed: Its runs.
    """
    columns: dict[tuple[int, int], list[int]] = defaultdict(list)
    for tile in joined:
        x, y = workspace.window(tile)[0].tolist()
        columns[x, y].append(tile)
    extent = (
        np.min([tile.first for tile in joined.values()], axis=0),
        np.max([tile.last for tile in joined.values()], axis=0),
    )
    paths_map = [item.trajectory_map.positions_world for item in placed]
    no_floor = _why_no_floor(extent, placed)
    floor = None if no_floor else _floor(workspace, joined, extent, manifest, paths_map)
    driven = None if floor is None else driven_ground(floor)
    raster = _raster(workspace, extent, driven)
    if workspace.follows_ground:
        _save_ground(raster, columns.values(), manifest, driven)
    band = Band(manifest.slice, manifest.octree.resolution_m, manifest.floor_z_m)
    done = _slice_columns(workspace, stages, columns.values(), band)
    if not _is_level(placed):
        return Sliced(done, None, None, None, no_floor)
    seen = np.zeros(raster.shape, np.uint8)
    for tiles in columns.values():
        raster.join(np.bitwise_or, seen, tiles[0], BAND)
    if driven is not None:
        band.free_path(seen, driven)
    grid, no_slice = None, ""
    try:
        grid = band.grid_of(seen, first=raster.first)
    except DataError as error:
        no_slice = f"no {error}"
    editors = editors_of(manifest, paths_map)
    keepout = None if grid is None else _keepout(grid, band, driven, editors)
    passable = None if floor is None else with_keepout(traversable(floor, manifest.traversable), editors)
    return Sliced(done, grid, keepout, passable, no_floor, no_slice)


def _is_level(placed: Sequence[Placed]) -> bool:
    return all(item.T_map_world[2, 2] >= np.cos(_MAX_TILT_RAD) for item in placed)


def _why_no_floor(extent: Extent, placed: Sequence[Placed]) -> str:
    """Return why no floor can be found; empty if one can."""
    if not _is_level(placed):
        return "no slice: a run is tilted by more than 5°, so z is not up in the map"
    cells = int(np.prod(extent[1] - extent[0]))
    if cells > MOST_COLUMNS:
        return (
            f"no traversable floor: the map's bounding box has {cells / 1e6:.0f} M columns, at most "
            f"{MOST_COLUMNS / 1e6:.0f} M fit into memory; merge fewer runs, or fuse with larger voxels"
        )
    return ""


def _floor(
    workspace: Workspace,
    joined: Mapping[int, JoinedTile],
    extent: Extent,
    manifest: MapManifest,
    paths_map: Sequence[Points],
) -> Floor:
    return floor_over(
        (np.load(workspace.piece(tile, OCCUPIED)) for tile in joined),
        extent,
        manifest.traversable,
        paths_map=paths_map,
        resolution_m=manifest.octree.resolution_m,
        floor_z_m=manifest.floor_z_m,
    )


def _slice_columns(
    workspace: Workspace, stages: Stages, columns: Collection[Sequence[int]], band: Band
) -> list[SlicedColumn]:
    jobs = {
        workspace.tiling.name_of(tiles[0]): partial(
            slice_column,
            workspace,
            tiles,
            band,
            ground=workspace.piece(tiles[0], GROUND) if workspace.follows_ground else None,
        )
        for tiles in columns
    }
    return [column for _, column in stages.run("slice", jobs, SlicedColumn)]


def _keepout(
    grid: OccupancyGrid, band: Band, driven: DrivenGround | None, editors: Sequence[MapEditor]
) -> OccupancyGrid | None:
    """Return where any run's keep-out regions are, in the slice's cells; None if there are none."""
    if not editors:
        return None
    level = band.floor_below(grid, driven)
    first, *others = (editor.keepout(grid, level) for editor in editors)
    return None if first is None else reduce(with_obstacles, others, first)


@dataclass(frozen=True, slots=True)
class _Raster:
    """Raster of the map's columns of voxels, into which pieces of tiles are joined.

    Attributes:
        workspace: Files of the merge, with the tiles' pieces.
        first: (2,) x and y keys of the first column.
        shape: H, W.
    """

    workspace: Workspace
    first: NDArray[np.int64]
    shape: tuple[int, int]

    def rows(self, rows: slice) -> "_Raster":
        """Return the part of the raster between two rows."""
        stop = min(rows.stop, self.shape[0])
        first = np.array([self.first[0], self.first[1] + rows.start])
        return _Raster(self.workspace, first, (stop - rows.start, self.shape[1]))

    def join(self, operation: np.ufunc, whole: NDArray[Any], tile: int, piece: str) -> None:
        """Join a tile's piece into an array of the raster's shape."""
        array = np.load(self.workspace.piece(tile, piece), mmap_mode="r")
        into, own = self.overlap(self.workspace.window(tile)[0], array.shape)
        operation(whole[into], array[own], out=whole[into])

    def overlap(
        self, first: NDArray[np.int64], size: tuple[int, ...]
    ) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
        """Return the rows and columns that a window covers, in the raster and in the window.

        Args:
            first: (2,) x and y keys of the window's first column.
            size: H, W of the window.
        """
        return overlap_of((first - self.first)[::-1], size, self.shape)


def _raster(workspace: Workspace, extent: Extent, driven: DrivenGround | None) -> _Raster:
    """Return the raster of the ground under the path, or else of all tiles."""
    if driven is not None:
        return _Raster(workspace, driven.first, (driven.swept.shape[0], driven.swept.shape[1]))
    first, last = extent
    return _Raster(workspace, first, (int(last[1] - first[1]), int(last[0] - first[0])))


def _save_ground(
    raster: _Raster,
    columns: Collection[Sequence[int]],
    manifest: MapManifest,
    driven: DrivenGround | None,
) -> None:
    workspace = raster.workspace
    tiles_of_row = defaultdict(list)
    for tiles in columns:
        for tile in tiles:
            tiles_of_row[int(workspace.window(tile)[0][1])].append(tile)
    resolution_m, floor = manifest.octree.resolution_m, known_floor(driven)
    ground = ground_from_lowest(
        _Lowest(raster, tiles_of_row),
        first=raster.first,
        resolution_m=resolution_m,
        floor_z_m=manifest.floor_z_m,
        floor=floor,
    )
    nearest = None if floor is None else nearest_heights(floor)
    for tiles in columns:
        first, size = workspace.window(tiles[0])
        heights_m = ground.under(first=first, shape=size)
        if nearest is not None:
            inside, own = raster.overlap(first, size)
            level, distances = nearest
            snap_to_floor(heights_m[own], level[inside], distances[inside], resolution_m=resolution_m)
        save_array(workspace.piece(tiles[0], GROUND), heights_m)


@dataclass(frozen=True, slots=True)
class _Lowest:
    """Tops of the lowest occupied voxels in all columns of the map, read on access.

    Attributes:
        raster: Raster of the map.
        tiles_of_row: Tiles by the y key of their first row.
    """

    raster: _Raster
    tiles_of_row: Mapping[int, Sequence[int]]

    @property
    def shape(self) -> tuple[int, int]:
        """H, W of the map."""
        return self.raster.shape

    def __getitem__(self, rows: slice) -> NDArray[np.int32]:
        band = self.raster.rows(rows)
        lowest = np.full(band.shape, NOTHING, np.int32)
        voxels, y = self.raster.workspace.tiling.voxels, int(band.first[1])
        for row in range(y // voxels * voxels, y + len(lowest), voxels):
            for tile in self.tiles_of_row.get(row, ()):
                band.join(np.minimum, lowest, tile, LOWEST)
        return lowest


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
