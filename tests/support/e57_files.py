"""E57 files, as pye57 writes them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapper.core.geometry import Transform, exp
from mapper.core.rotations import row_of_pose

POSES = [exp(np.array([0.0, 0.0, 0.3 * k]), np.array([2.0 * k, 0.5, 1.0])) for k in range(3)]


def fields(seed: int, *, count: int = 50) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return points of a scan, and these with intensities and colours by pye57's names."""
    random = np.random.default_rng(seed)
    xyz = random.uniform(-9.0, 9.0, (count, 3))
    data = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), xyz.T.copy(), strict=True))
    data["intensity"] = random.uniform(0.0, 1.0, count).astype(np.float32)
    for name in ("colorRed", "colorGreen", "colorBlue"):
        data[name] = random.integers(0, 256, count).astype(np.uint8)
    return xyz, data


def write(path: Path, *scans: dict[str, np.ndarray], poses: Sequence[Transform] = POSES) -> Path:
    """Write scans with their poses."""
    import pye57

    with pye57.E57(str(path), mode="w") as file:
        for data, T in zip(scans, poses, strict=False):
            x, y, z, qx, qy, qz, qw = row_of_pose(T)
            file.write_scan_raw(data, rotation=np.array([qw, qx, qy, qz]), translation=np.array([x, y, z]))
    return path
