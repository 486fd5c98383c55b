"""Streets and yards that do not exist, scanned by a LiDAR whose every motion is known."""

from mapper.sources.synthetic.lidar.dense import sample_map
from mapper.sources.synthetic.lidar.log import write_lidar_log
from mapper.sources.synthetic.lidar.scene import OutdoorScene, make_outdoor_scene
from mapper.sources.synthetic.lidar.sensor import render_scan, render_sweep
from mapper.sources.synthetic.lidar.source import SyntheticLidarSource

__all__ = [
    "OutdoorScene",
    "SyntheticLidarSource",
    "make_outdoor_scene",
    "render_scan",
    "render_sweep",
    "sample_map",
    "write_lidar_log",
]
