"""Settings of products that are made on demand: meshes and viewer recordings."""

from typing import Annotated

from pydantic import Field, PositiveFloat, PositiveInt

from mapper.core.config import Config


class MeshConfig(Config):
    """The surface of ``mapper export --as mesh``: truncated signed distances (Curless & Levoy 1996)."""

    voxel_m: PositiveFloat = 0.01
    truncation_voxels: Annotated[float, Field(ge=1.0)] = 4.0
    """How far from the surface distances count; thinner than the depth noise tears holes."""
    max_depth_m: PositiveFloat = 4.0
    """Deeper measurements are left out."""
    frame_stride: PositiveInt = 5
    """Every n-th tracked frame is fused."""
    min_observations: PositiveInt = 3
    """Surface seen in fewer fused frames is left out."""


class RerunConfig(Config):
    """Settings of what a viewer shows while a map is built."""

    image_stride: PositiveInt = 3
    """Every n-th frame is shown with its image and cloud, which costs reading it again."""
    image_width_px: PositiveInt = 480
    """Wider images are shrunk."""
    cloud_points: PositiveInt = 20_000
    """A frame's cloud is thinned to about so many points."""
