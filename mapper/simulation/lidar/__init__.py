"""Simulated LiDAR logs: streets and yards, a route through them, and what a LiDAR sees, with exact truth."""

from mapper.simulation.lidar.scene import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.source import LidarSimulator, write_lidar_log

__all__ = [
    "LidarSimulator",
    "OutdoorScene",
    "make_outdoor_scene",
    "write_lidar_log",
]
