"""Results of the C++ library from the same scans, and the real scans to try."""

import cv2
import numpy as np
import pyoctomap

from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.core.geometry import apply, inverse
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
    truth = np.loadtxt(FR1_XYZ / "groundtruth.txt")
    camera = PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3)
    lines = [line.split() for line in (FR1_XYZ / "depth.txt").read_text().splitlines() if line[0] != "#"]
    scans = []
    for stamp, name in lines[:: len(lines) // count][:count]:
        t, q = np.split(truth[np.argmin(np.abs(truth[:, 0] - float(stamp))), 1:], [3])
        x, y, z, w = q
        T_world_camera = np.eye(4)
        T_world_camera[:3, 3] = t
        T_world_camera[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        depth_m = cv2.imread(str(FR1_XYZ / name), cv2.IMREAD_UNCHANGED).astype(np.float32) / 5000
        scan = RgbdFrame(0, np.zeros((480, 640), np.uint8), depth_m, camera).scan()
        scans.append((apply(T_world_camera, scan.points_body).astype(np.float32), t))
    return scans


def kitti_scans(count):
    """Return (points_world, origin_world) of the first scans of KITTI 00."""
    T_camera_lidar = np.eye(4)
    for line in (KITTI / "calib.txt").read_text().splitlines():
        if line.startswith("Tr:"):
            T_camera_lidar[:3] = np.array(line.split()[1:], dtype=float).reshape(3, 4)
    scans = []
    for i, row in enumerate(np.loadtxt(KITTI / "poses.txt")[:count]):
        T_first_camera = np.vstack([row.reshape(3, 4), [0, 0, 0, 1]])
        T_world_lidar = inverse(T_camera_lidar) @ T_first_camera @ T_camera_lidar
        points = np.fromfile(KITTI / f"velodyne/{i:06d}.bin", dtype=np.float32).reshape(-1, 4)[:, :3]
        scans.append((apply(T_world_lidar, points).astype(np.float32), T_world_lidar[:3, 3]))
    return scans
