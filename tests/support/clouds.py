"""Cloud files of every format that is read."""

from pathlib import Path

import laspy
import numpy as np
from pypcd4 import Encoding, PointCloud

from mapper.export.mesh_files import write_ply


def save_cloud(path: Path, points: np.ndarray) -> None:
    """Write (N, 3) points in the format of a path's ending."""
    match path.suffix:
        case ".bin":
            np.pad(points, ((0, 0), (0, 1))).astype("<f4").tofile(path)
        case ".npy":
            np.save(path, points)
        case ".pcd":
            PointCloud.from_xyz_points(points.round(1)).save(path, Encoding.BINARY_COMPRESSED)
        case ".ply":
            write_ply(path, points, np.full(points.shape, 7, np.uint8))
        case ".las" | ".laz":
            header = laspy.LasHeader(point_format=3 if path.stem.endswith("0") else 7)
            header.scales = np.full(3, 1e-3)
            cloud = laspy.LasData(header)
            cloud.x, cloud.y, cloud.z = points.astype(np.float64).T
            cloud.gps_time = np.linspace(0.0, 0.1, len(points))
            cloud.write(path)
        case ending:
            np.savetxt(path, points, delimiter="," if ending == ".csv" else " ", fmt="%.4f")
