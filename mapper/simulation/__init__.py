"""Simulated RGB-D logs: a furnished flat, a path through it, and what a camera sees, with exact truth."""

from mapper.simulation.boxes import Boxes, read_scene
from mapper.simulation.kinect import observe
from mapper.simulation.raycast import Rendering, render
from mapper.simulation.scene import Scene, make_scene
from mapper.simulation.source import CameraSimulator, camera_of, write_tum_log

__all__ = [
    "Boxes",
    "CameraSimulator",
    "Rendering",
    "Scene",
    "camera_of",
    "make_scene",
    "observe",
    "read_scene",
    "render",
    "write_tum_log",
]
