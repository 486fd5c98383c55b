"""Configuration of a build, and of products that are made on demand: meshes and viewer recordings."""

from typing import Annotated, Self

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from mapper.core.config import Config, Ratio
from mapper.graph.config import GraphConfig
from mapper.loops.config import LoopsConfig, PlaceLoopsConfig
from mapper.mapping.config import CloudConfig, LevelConfig, McapConfig
from mapper.navigation.config import CostmapConfig, TraversableConfig
from mapper.octree.config import OctreeConfig, Parent, SliceConfig
from mapper.odometry.config import LocalMapConfig, OdometryConfig
from mapper.sources.config import SourceConfig


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
    cloud_points: PositiveInt = 20_000
    """A frame's cloud is thinned to about this many points."""


class BuildConfig(Config):
    """All settings of ``mapper build``."""

    source: SourceConfig = SourceConfig()
    odometry: OdometryConfig = LocalMapConfig()
    """Method that finds the sensor's motion from frame to frame."""
    loops: LoopsConfig = PlaceLoopsConfig()
    """Method that recognises places where the sensor was before."""
    graph: GraphConfig = GraphConfig()
    octree: OctreeConfig = OctreeConfig()
    level: LevelConfig = LevelConfig()
    slice: SliceConfig = SliceConfig()
    traversable: TraversableConfig = TraversableConfig()
    cloud: CloudConfig = CloudConfig()
    mcap: McapConfig = McapConfig()
    rerun: RerunConfig = RerunConfig()
    mesh: MeshConfig = MeshConfig()
    costmap: CostmapConfig = CostmapConfig()
    octomap: OctomapConfig = OctomapConfig()
    min_tracked_frames: PositiveInt = 10
    """With fewer frames tracked no map is made, and the build ends in an error."""
    min_tracked_ratio: Ratio = 0.2
    """With a smaller share of the readable frames tracked no map is made, and the build ends in an error."""
    workers: NonNegativeInt = 2
    """Threads that read, decode and detect features ahead; the result does not depend on their number."""

    @model_validator(mode="after")
    def _voxels_fit_the_slice(self) -> Self:
        most_m = 2.0 * self.slice.max_height_m  # the floor is a border of voxels
        if self.octree.resolution_m > most_m:
            raise ValueError(
                f"octree.resolution_m is {self.octree.resolution_m:g} m, so no voxel has its centre below "
                f"slice.max_height_m; want at most {most_m:g}; 0.05 is 5 cm"
            )
        return self
