"""Configuration of a build."""

from pydantic import NonNegativeInt, PositiveInt

from mapper.config.export import MeshConfig, OctomapConfig, RerunConfig
from mapper.core.config import Config, Ratio
from mapper.graph.config import GraphConfig
from mapper.loops.config import LoopsConfig, PlaceLoopsConfig
from mapper.mapping.config import CloudConfig, LevelConfig, McapConfig
from mapper.navigation.config import CostmapConfig, TraversableConfig
from mapper.octree.config import OctreeConfig, SliceConfig
from mapper.odometry.config import LocalMapConfig, OdometryConfig
from mapper.sources.config import SourceConfig


class BuildConfig(Config):
    """All settings of ``mapper build``."""

    source: SourceConfig = SourceConfig()
    odometry: OdometryConfig = LocalMapConfig()
    loops: LoopsConfig = PlaceLoopsConfig()
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
    """The same, as a share of the frames that could be read."""
    workers: NonNegativeInt = 2
    """Threads that decode and detect ahead; the result does not depend on it."""
