"""Default settings per sensor, where they differ from the classes' own defaults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mapper.core.frames import Sensor

DEFAULTS: Mapping[Sensor, Mapping[str, Any]] = {
    "rgbd": {},
    "lidar": {
        "odometry": {"kind": "gicp"},
        "loops": {"kind": "scans"},
        "octree": {"resolution_m": 0.2, "max_range_m": 80.0},
        "level": {"plane_tolerance_m": 0.1},
        "slice": {"min_height_m": 0.3, "max_height_m": 2.0, "above": "ground"},
        "traversable": {"max_step_m": 0.2, "slope_window_m": 2.0, "head_room_m": 2.0, "max_gap_m": 1.0},
        "costmap": {"robot_radius_m": 0.5, "inflation_radius_m": 2.0, "cost_scaling": 3.0},
        "cloud": {"voxel_m": 0.1, "frame_stride": 4},
    },
}
"""A street is coarser than a room: what would be a step indoors is within the noise of the road."""
