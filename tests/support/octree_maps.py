"""Small octree maps of random scans."""

import numpy as np

from mapper.core.frames import Scan
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap

CONFIG = OctreeConfig(resolution_m=0.1, max_range_m=3.0)
COLORED = CONFIG.model_copy(update={"attributes": True})


def octree_of(scans, *, resolution_m=0.05, max_range_m=4.0, discretize=True):
    """Return our map of (points_world f32, origin_world) pairs; see octomap_oracle.fuse for OctoMap's."""
    octree = OctreeMap(
        OctreeConfig(resolution_m=resolution_m, max_range_m=max_range_m, discretize=discretize)
    )
    for points, origin in scans:
        octree.insert_points(points, origin)
    return octree


def mapped(seed, *, config=CONFIG, scans=5):
    """Return a map of a few random scans, coloured if the settings keep colours."""
    rng = np.random.default_rng(seed)
    octree = OctreeMap(config)
    for i in range(scans):
        points = rng.normal(0.0, 1.2, (60, 3)).astype(np.float32)
        pose = np.eye(4)
        pose[:3, 3] = rng.normal(0.0, 0.4, 3)
        colors = rng.integers(0, 256, (60, 3), dtype=np.uint8) if config.attributes else None
        octree.insert(Scan(1000 * seed + i, points, colors=colors), pose)
    return octree


def total(maps, *, config=CONFIG):
    """Return the sum of maps, and what each overlapped with those before it."""
    octree = OctreeMap(config)
    overlaps = [octree.add(other) for other in maps]
    octree.clamp()
    return octree, overlaps


def as_dict(octree):
    """Return {key: log-odds} of a map's leaves."""
    leaves = octree.leaves()
    return {tuple(key): value for key, value in zip(leaves.keys.tolist(), leaves.log_odds, strict=True)}


def attributes_of_leaves(octree):
    """Return the attributes of all known voxels, in the order of the map's leaves."""
    return octree.attributes.at(octree.leaves().centres_world)
