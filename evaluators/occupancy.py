"""How right an occupancy map is about a world whose solids are known exactly."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from evaluators.metric import Metric
from mapper.errors import DataError
from mapper.geometry import Array, Points
from mapper.octree.map import OctreeMap

SignedDistance = Callable[[Points], Array]
"""Maps (N, 3) points in metres to their distances from the nearest surface, negative inside solids."""

_SQRT3 = float(np.sqrt(3.0))


def occupancy_metrics(
    octree: OctreeMap, signed_distance_m: SignedDistance, *, voxels: int = 1
) -> list[Metric]:
    """Return precision and recall of occupied and of free space, each within some voxels.

    Precision: an occupied voxel is right if its middle is within the tolerance, and half a voxel, of a solid;
    a free one if it is as near to free space. Recall asks where the map looked, its known voxels: a surface
    that passes through the middle half of one is found if an occupied voxel is within the tolerance, along
    each axis; space with no solid within the tolerance is found if it is free.

    Args:
        octree: The map, in the frame of the truth.
        signed_distance_m: The truth.
        voxels: The tolerance.

    Raises:
        DataError: The map is empty, or knows no surface or no free space.
    """
    leaves = octree.leaves()
    centres, edge_m = leaves.centres_world, leaves.resolution_m
    occupied = leaves.log_odds >= octree.occupied_log_odds
    distance_m = signed_distance_m(centres)
    reach_m = (voxels + 0.5) * edge_m
    surface, open_space = np.abs(distance_m) <= 0.25 * edge_m, distance_m > reach_m * _SQRT3
    if not (occupied.any() and surface.any() and open_space.any() and not occupied.all()):
        raise DataError(
            "occupancy: the map knows no surface or no free space; is it in the frame of the truth?"
        )
    found = _near(leaves.keys[surface], leaves.keys[occupied], voxels=voxels)
    within = f"within {voxels} voxel{'s' if voxels != 1 else ''}"
    return [
        Metric(f"occupied precision, {within}", float((distance_m[occupied] <= reach_m).mean()), "ratio"),
        Metric(f"occupied recall, {within}", float(found.mean()), "ratio"),
        Metric(f"free precision, {within}", float((distance_m[~occupied] >= -reach_m).mean()), "ratio"),
        Metric(f"free recall, {within}", float((~occupied[open_space]).mean()), "ratio"),
    ]


def ghosts(octree: OctreeMap, signed_distance_m: SignedDistance, *, voxels: int = 1) -> int:
    """Return how many voxels are occupied further than so many voxels, and a half, from every solid."""
    leaves = octree.leaves()
    occupied = leaves.centres_world[leaves.log_odds >= octree.occupied_log_odds]
    return int((signed_distance_m(occupied) > (voxels + 0.5) * leaves.resolution_m).sum())


def _near(keys: NDArray[np.uint16], others: NDArray[np.uint16], *, voxels: int) -> NDArray[np.bool_]:
    """Tell for each of (N, 3) keys whether another is at most so many steps away along each axis."""
    near, codes = np.zeros(len(keys), dtype=np.bool_), np.sort(_packed(others.astype(np.int64)))
    for step in np.ndindex(*(2 * voxels + 1,) * 3):
        wanted = _packed(keys + (np.array(step, dtype=np.int64) - voxels))
        place = np.minimum(np.searchsorted(codes, wanted), len(codes) - 1)
        near |= codes[place] == wanted
    return near


def _packed(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    packed: NDArray[np.int64] = keys[:, 0] | keys[:, 1] << 20 | keys[:, 2] << 40
    return packed
