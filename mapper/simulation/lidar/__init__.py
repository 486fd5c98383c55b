"""Streets and yards that do not exist, scanned by a LiDAR whose every motion is known."""

from mapper.simulation.lidar.dense import sample_map
from mapper.simulation.lidar.log import write_lidar_log
from mapper.simulation.lidar.scene import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.sensor import render_scan, render_sweep
from mapper.simulation.lidar.source import SyntheticLidarSource

__all__ = [
    "OutdoorScene",
    "SyntheticLidarSource",
    "make_outdoor_scene",
    "render_scan",
    "render_sweep",
    "sample_map",
    "write_lidar_log",
]
