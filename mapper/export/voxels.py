"""Occupied voxels for viewers without octrees: as points, and as the outside of cubes."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import RunError
from mapper.export.mesh_files import Triangles, write_mesh, write_ply
from mapper.mapping.cloud import height_colors
from mapper.octree.keys import KEY_ZERO
from mapper.octree.queries import Leaves
from mapper.run import files
from mapper.run.folder import Run
from mapper.runtime.progress import Progress

Corners = NDArray[np.int64]
_AXIS_BITS = 17  # keys take 16; the corners of the last voxel and the neighbours of the first need room

# Per normal axis, the horizontal axis that faces are joined along, and the remaining one.
_ALONG_ACROSS = ((1, 2), (0, 2), (0, 1))


def centres(run: Run, path: Path, _progress: Progress) -> None:
    """Write the centres of the occupied voxels as points coloured by height."""
    points_world = _occupied(run).centres_world.astype(np.float32)
    write_ply(path, points_world, height_colors(points_world[:, 2]))


def cubes(run: Run, path: Path, _progress: Progress) -> None:
    """Write the outside of the occupied voxels as triangles coloured by height."""
    occupied = _occupied(run)
    corners, triangles = outside(occupied.keys.astype(np.int64))
    points_world = ((corners - KEY_ZERO) * occupied.resolution_m).astype(np.float32)
    write_mesh(path, points_world, height_colors(points_world[:, 2]), triangles)


def outside(keys: Corners) -> tuple[Corners, Triangles]:
    """Return the faces between voxels and what is not among them, rows of equal faces joined.

    Faces are joined along one horizontal axis, so that a colour by height stays exact.

    Args:
        keys: (N, 3) distinct voxel keys.

    Returns:
        (V, 3) lattice corners, corner (0, 0, 0) being the lowest of key (0, 0, 0), and (T, 3) triangles
        that turn counterclockwise seen from outside.
    """
    rectangles = [_rectangles(keys, axis, side) for axis in range(3) for side in (0, 1)]
    codes = _codes(np.concatenate(rectangles).reshape(-1, 3))
    distinct, index = np.unique(codes, return_inverse=True)
    mask = (1 << _AXIS_BITS) - 1
    corners = np.column_stack([(distinct >> (_AXIS_BITS * axis)) & mask for axis in range(3)]) - 1
    quads = index.reshape(-1, 4).astype(np.int32)
    return corners, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def _rectangles(keys: Corners, axis: int, side: int) -> Corners:
    """Return the (R, 4, 3) corners of the joined faces on one side of the voxels."""
    along, across = _ALONG_ACROSS[axis]
    codes = np.sort(_codes(keys))
    beyond = keys.copy()
    beyond[:, axis] += 1 if side else -1
    neighbours = _codes(beyond)
    place = np.minimum(np.searchsorted(codes, neighbours), len(codes) - 1)
    faces = keys[codes[place] != neighbours] if len(keys) else keys
    faces = faces[np.lexsort((faces[:, along], faces[:, across], faces[:, axis]))]

    step = np.zeros(3, np.int64)
    step[along] = 1
    starts = np.flatnonzero((np.diff(faces, axis=0, prepend=faces[:1] - 2) != step).any(axis=1))
    lengths = np.diff(starts, append=len(faces))
    low = faces[starts]
    low[:, axis] += side
    high = low.copy()
    high[:, along] += lengths
    up = np.zeros(3, np.int64)
    up[across] = 1
    around = [low, high, high + up, low + up]
    if (axis == 1) == bool(side):  # along × across is −y, but +x and +z
        around.reverse()
    return np.stack(around, axis=1)


def _codes(lattice: Corners) -> Corners:
    """Return one number for each (N, 3) lattice point from −1 up."""
    x, y, z = (lattice + 1).T
    code: Corners = x | (y << _AXIS_BITS) | (z << (2 * _AXIS_BITS))
    return code


def _occupied(run: Run) -> Leaves:
    octree = run.octree
    leaves = octree.leaves()
    is_occupied = leaves.log_odds >= octree.occupied_log_odds
    if not is_occupied.any():
        raise RunError(
            f"{run.path / files.OCTREE_MAP}: no voxel is occupied; lower octree.occupied_probability"
        )
    return Leaves(leaves.keys[is_occupied], leaves.log_odds[is_occupied], leaves.resolution_m)
