"""The first occupied voxel along rays, as OctoMap's ``castRay`` finds it."""

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Points
from mapper.octree import queries
from mapper.octree.blocks import BlockStore
from mapper.octree.casting import origin_key
from mapper.octree.keys import KEY_ZERO
from mapper.octree.leaves import RayEnds


def first_obstacles(
    blocks: BlockStore,
    origins_world: Points,
    directions_world: Points,
    *,
    resolution_m: float,
    threshold: np.float32,
    max_range_m: float,
    through_unknown: bool,
) -> RayEnds:
    """Return the first occupied voxel along rays.

    Args:
        blocks: The map's.
        origins_world: (N, 3) metres.
        directions_world: (N, 3) of any length but zero.
        resolution_m: Edge of a voxel.
        threshold: Least log-odds of an occupied voxel.
        max_range_m: Rays end without a hit once a voxel's centre is further away.
        through_unknown: Pass unknown voxels; otherwise a ray ends, without a hit, in the first.

    Raises:
        DataError: Shapes differ, a direction is zero or not finite, or an origin has no key.
    """
    origins = np.ascontiguousarray(origins_world, dtype=np.float32)
    directions = np.ascontiguousarray(directions_world, dtype=np.float32)
    if origins.shape != directions.shape or origins.ndim != 2 or origins.shape[1] != 3:
        raise DataError(f"octree: rays from {origins.shape} along {directions.shape}, want two (N, 3)")
    if not np.isfinite(directions).all() or not directions.any(axis=1).all():
        raise DataError("octree: every ray needs a finite direction other than zero")
    for corner in (origins.min(axis=0, initial=0.0), origins.max(axis=0, initial=0.0)):
        origin_key(corner, resolution_m)
    keys, outcomes = queries.first_obstacles(
        blocks.table,
        origins,
        directions,
        resolution_m,
        max_range_m,
        threshold,
        through_unknown,
    )
    centres_world = (keys - (KEY_ZERO - 0.5)) * resolution_m
    distances_m = np.linalg.norm(centres_world - origins_world, axis=1)
    return RayEnds(centres_world, distances_m, outcomes == queries.HIT)
