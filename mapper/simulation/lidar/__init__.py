"""Simulated LiDAR logs: streets and yards, a route through them, and what a LiDAR sees, with exact truth."""

from mapper.simulation.lidar.log import write_lidar_log
from mapper.simulation.lidar.scene import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.sensor import render_scan
from mapper.simulation.lidar.source import LidarSimulator

__all__ = [
    "LidarSimulator",
    "OutdoorScene",
    "make_outdoor_scene",
    "render_scan",
    "write_lidar_log",
]
