"""Paths of the repository and of the shared recorded data."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs"
SHARED = ROOT.parent / "shared"
DATA = SHARED / "data"
FR1_XYZ = DATA / "tum_fr1_xyz"
KITTI = DATA / "kitti_00"
POSE_GRAPHS = DATA / "posegraph"
