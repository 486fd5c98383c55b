"""Results of the C++ library from the same scans, and the real scans to try."""

import numpy as np
import pyoctomap

from mapper.core.geometry import apply
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from tests.support.paths import FR1_XYZ, KITTI


def fuse(scans, *, resolution_m, max_range_m, discretize, lazy=False):
    """Return the OctoMap tree of (points_world f32, origin_world) pairs."""
    tree = pyoctomap.OcTree(resolution_m)
    for points, origin in scans:
        tree.insertPointCloud(
            points.astype(np.float64), origin, max_range=max_range_m, lazy_eval=lazy, discretize=discretize
        )
    if lazy:
        tree.updateInnerOccupancy()
    return tree


def voxels(tree, *, resolution_m):
    """Return {key: log-odds} of a tree, its pruned leaves expanded."""
    found = {}
    for leaf in tree.begin_leafs():
        n = 1 << (16 - leaf.getDepth())
        low = np.round(np.array(leaf.getCoordinate()) / resolution_m - n / 2).astype(int) + 32768
        value = np.float32(leaf.current_node.getLogOdds())
        for offset in np.ndindex(n, n, n):
            found[tuple((low + offset).tolist())] = value
    return found


def fr1_xyz_scans(count):
    """Return (points_world, origin_world) of depth frames spread over fr1_xyz, at the true poses."""
    log = open_source(FR1_XYZ, SourceConfig(require_truth=True))
    return _placed(log, range(len(log))[1 :: len(log) // count][:count])


def kitti_scans(count):
    """Return (points_world, origin_world) of the first scans of KITTI 00."""
    return _placed(open_source(KITTI), range(count))


def _placed(log, numbers):
    scans = []
    for number in numbers:
        T_world_body = log.truth.at(int(log.stamps_ns[number]))
        points_world = apply(T_world_body, log.entry_at(number).scan().points_body)
        scans.append((points_world.astype(np.float32), T_world_body[:3, 3]))
    return scans
