"""Centres of the objects on the ground, seen from above (Nagy, Gálai & Benedek 2016, §3.2)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array
from mapper.registration.hough.config import CellsConfig, ObjectsConfig


def centres_of(obstacles: Points32, config: CellsConfig | ObjectsConfig) -> Array:
    """Return the (N, 2) centres, metres, of the obstacles' objects or occupied cells.

    Args:
        obstacles: (M, 3) one point per voxel, as ``find_obstacles`` gives them.
        config: Cells or objects.
    """
    if len(obstacles) == 0:
        return np.empty((0, 2))
    flat = obstacles[:, :2].astype(np.float64)
    if isinstance(config, ObjectsConfig):
        component_of = _objects(flat, config)
    else:
        _, component_of = np.unique(_cell_numbers(flat, config.cell_m), return_inverse=True)
    sizes = np.bincount(component_of)
    sums = np.column_stack([np.bincount(component_of, weights=flat[:, axis]) for axis in range(2)])
    large = sizes >= _min_voxels(flat, config)
    return sums[large] / sizes[large, np.newaxis]


def _min_voxels(flat: Array, config: CellsConfig | ObjectsConfig) -> float:
    """Return the least number of voxels of an object or an occupied cell, in a cloud of this density."""
    cell_m = config.coarse_m if isinstance(config, ObjectsConfig) else config.cell_m
    _, counts = np.unique(_cell_numbers(flat, cell_m), return_counts=True)
    return max(1.0, config.min_voxels_ratio * float(np.median(counts)))


def _objects(flat: Array, config: ObjectsConfig) -> NDArray[np.intp]:
    """Return each voxel's object: its component by fine cells, or its group where no component is large."""
    group_of, component_of = _connected(flat, config.coarse_m), _connected(flat, config.fine_m)
    large = np.bincount(component_of) >= _min_voxels(flat, config)
    divided = np.zeros(group_of.max() + 1, np.bool_)
    divided[group_of[large[component_of]]] = True
    return np.where(divided[group_of], component_of, len(large) + group_of)


def _connected(flat: Array, cell_m: float) -> NDArray[np.intp]:
    """Return each point's component of cells that touch at a side or a corner."""
    cells = _cells(flat, cell_m)
    cells -= cells.min(axis=0)
    image = np.zeros(cells.max(axis=0) + 1, np.uint8)
    image[cells[:, 0], cells[:, 1]] = 1
    labels: NDArray[np.int32] = cv2.connectedComponents(image, connectivity=8)[1]
    return labels[cells[:, 0], cells[:, 1]].astype(np.intp) - 1


def _cell_numbers(flat: Array, cell_m: float) -> NDArray[np.int64]:
    """Return the number of each point's cell."""
    cells = _cells(flat, cell_m)
    cells -= cells.min(axis=0)
    numbers: NDArray[np.int64] = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    return numbers


def _cells(flat: Array, cell_m: float) -> NDArray[np.int64]:
    return np.floor(flat / cell_m).astype(np.int64)
