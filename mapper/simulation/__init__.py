"""Synthetic RGB-D logs with exact truth: a furnished flat, recorded by a simulated Kinect."""

from mapper.simulation.boxes import Boxes, read_scene
from mapper.simulation.log import write_tum_log
from mapper.simulation.path import make_path
from mapper.simulation.raycast import Rendering, render
from mapper.simulation.scene import Scene, make_scene
from mapper.simulation.sensor import observe
from mapper.simulation.source import SyntheticSource, camera_of

__all__ = [
    "Boxes",
    "Rendering",
    "Scene",
    "SyntheticSource",
    "camera_of",
    "make_path",
    "make_scene",
    "observe",
    "read_scene",
    "render",
    "write_tum_log",
]
