"""Settings of products that are made on demand: meshes and viewer recordings."""

from typing import Annotated

from pydantic import Field, PositiveFloat, PositiveInt

from mapper.core.config import Config
from mapper.octree.config import Parent


class MeshConfig(Config):
    """The surface of ``mapper export --as mesh``: truncated signed distances (Curless & Levoy 1996)."""

    voxel_m: PositiveFloat = 0.01
    """Edge of a voxel of the signed distances. Smaller shows finer shapes and needs far more memory."""
    max_depth_m: PositiveFloat | None = None
    """Deeper measurements are left out; None uses the octree's limit."""
    frame_stride: PositiveInt = 5
    """Every n-th tracked frame is fused."""
    min_observations: PositiveInt = 3
    """Surface seen in fewer fused frames is left out."""


class OctomapConfig(Config):
    """The octree of ``mapper export --as octomap``."""

    level: Annotated[int, Field(ge=0, le=12)] = 0
    """Levels of the tree that are dropped: voxels are 2**level times as wide as the map's."""
    parent: Parent = "mean"
    """Log-odds of a wider voxel: "mean" of its content (Zhao et al. 2020, eq. 14), or "max", which misses
    nothing occupied."""


class RerunConfig(Config):
    """Settings of what a viewer shows while a map is built."""

    image_stride: PositiveInt = 3
    """Every n-th frame is shown with its image and cloud, which costs reading it again."""
    image_width_px: PositiveInt = 480
    """Wider images are shrunk."""
    cloud_points: PositiveInt = 20_000
    """A frame's cloud is thinned to about this many points."""
