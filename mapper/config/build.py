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
