"""Slice and picture of a merged map: one raster, joined from those of the columns of tiles."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.export.picture import write_merged
from mapper.merging.jobs import JoinedTile, SlicedColumn, Workspace, save_ground, slice_column
from mapper.merging.merged_map import MapManifest
from mapper.merging.placing import Placed
from mapper.merging.stages import Stages
from mapper.octree.ground_height import NOTHING, ground_from_lowest
from mapper.octree.slice import OccupancyGrid, grid_of, shrunk

_MOST_CELLS = 2000  # more than a page has pixels
_MAX_TILT = np.cos(np.deg2rad(5.0))


def slice_map(
    workspace: Workspace,
    stages: Stages,
    joined: Mapping[int, JoinedTile],
    manifest: MapManifest,
    placed: Sequence[Placed],
) -> tuple[list[SlicedColumn], OccupancyGrid | None, list[str]]:
    """Return the results of all columns of tiles, the slice, and the reason if there is none."""
    first = np.min([tile.first for tile in joined.values()], axis=0)
    last = np.max([tile.last for tile in joined.values()], axis=0)
    shape = int(last[1] - first[1]), int(last[0] - first[0])
    columns, rows = defaultdict(list), defaultdict(list)
    for tile in joined:
        x, y = workspace.window(tile)[0].tolist()
        columns[x, y].append(tile)
        rows[y].append(tile)
    ground_path = None
    if manifest.slice.above == "ground":
        ground = ground_from_lowest(
            _Lowest(workspace, rows, first, shape),
            first=first,
            resolution_m=manifest.octree.resolution_m,
            floor_z_m=manifest.floor_z_m,
        )
        ground_path = workspace.scratch / "ground.npz"
        save_ground(ground_path, ground)
    jobs = {
        workspace.tiling.name_of(tiles[0]): partial(
            slice_column, workspace, tiles, manifest.slice, ground=ground_path, floor_z_m=manifest.floor_z_m
        )
        for tiles in columns.values()
    }
    done = [column for _, column in stages.run("slice", jobs, SlicedColumn)]
    if any(item.T_map_world[2, 2] < _MAX_TILT for item in placed):
        return done, None, ["no slice: a run is tilted by more than 5°, so z is not up in the map"]
    seen = np.zeros(shape, np.uint8)
    for tiles in columns.values():
        _over(np.bitwise_or, seen, first, workspace, tiles[0], "band")
    try:
        grid = grid_of(
            seen,
            manifest.slice,
            first=first,
            resolution_m=manifest.octree.resolution_m,
            floor_z_m=manifest.floor_z_m,
        )
    except DataError as error:
        return done, None, [f"no {error}"]
    return done, grid, []


@dataclass(frozen=True, slots=True)
class _Lowest:
    """The tops of the lowest occupied voxels in all columns of the map, read when they are asked for.

    Attributes:
        workspace: With the tiles' pieces.
        tiles: By the y key of their first row.
        first: (2,) x and y keys of the map's first column.
        shape: H, W.
    """

    workspace: Workspace
    tiles: Mapping[int, Sequence[int]]
    first: NDArray[np.int64]
    shape: tuple[int, int]

    def __getitem__(self, rows: slice) -> NDArray[np.int32]:
        x, y = int(self.first[0]), int(self.first[1]) + rows.start
        band = np.full((min(rows.stop, self.shape[0]) - rows.start, self.shape[1]), NOTHING, np.int32)
        voxels = self.workspace.tiling.voxels
        for row in range(y // voxels * voxels, y + len(band), voxels):
            for tile in self.tiles.get(row, ()):
                _over(np.minimum, band, np.array([x, y]), self.workspace, tile, "lowest")
        return band


def _over(
    join: np.ufunc, whole: NDArray[Any], first: NDArray[np.int64], workspace: Workspace, tile: int, piece: str
) -> None:
    """Join a tile's piece into a raster whose first column has these keys."""
    array = np.load(workspace.piece(tile, piece), mmap_mode="r")
    x, y = workspace.window(tile)[0] - first
    rows, columns = (slice(max(at, 0), at + size) for at, size in zip((y, x), array.shape, strict=True))
    into = whole[rows, columns]
    join(into, array[max(-y, 0) :, max(-x, 0) :][: into.shape[0], : into.shape[1]], out=into)


def draw(path: Path, grid: OccupancyGrid, placed: Sequence[Placed], manifest: MapManifest) -> None:
    """Draw the runs' paths over the slice."""
    write_merged(
        path,
        grid=shrunk(grid, _MOST_CELLS),
        paths_world={item.run.path.name: item.trajectory_map.positions_world for item in placed},
        tile_m=manifest.tile_m,
        title=f"{len(placed)} runs merged",
        lines=[manifest.summary],
    )
