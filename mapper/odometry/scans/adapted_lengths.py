"""Lengths of a scan odometry, adapted to how narrow the surroundings of a log are."""

import numpy as np

from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import spread_indices
from mapper.core.voxel_grid import thin
from mapper.odometry.config import OdometryConfig
from mapper.odometry.scans.config import AnyScanOdometryConfig
from mapper.sources.base import Log

_SCANS = 9  # evenly spread over the log
_CELL_M = 0.5
_VOXEL_SHARE, _SMALLEST_VOXEL_M = 0.06, 0.15
"""Largest voxel as a share of the median distance: rooms have 2.5 to 4 m, a tunnel 8, a field and streets 15
to 30. In a room voxels of 0.4 m leave 500 points, whose pose is off by 0.08 m; in a field ones of 0.3 m have
too few points for normals."""


def adapted_to(config: OdometryConfig, log: Log) -> OdometryConfig:
    """Return the settings with lengths for a log's surroundings; only a scan odometry's change.

    Without ``scale`` lengths are multiplied by what makes the voxel at most 0.06 of the median distance (the
    "spaciousness" of Chen, Lopez, Agha-mohammadi & Mehta 2022, §III-C) or 0.15 m, whichever is more.
    """
    if not isinstance(config, AnyScanOdometryConfig):
        return config
    scale = config.scale
    if scale is None:
        distance_m = _median_distance_m(log)
        if distance_m is None:
            return config
        scale = min(1.0, max(_VOXEL_SHARE * distance_m, _SMALLEST_VOXEL_M) / config.voxel_m)
    return config.scaled(scale)


def spaciousness_m(scan: Scan) -> float:
    """Return the median distance of the cells that a scan's points lie in, metres.

    Cells and not points: most points of any scan are the ground's next to the sensor.
    """
    cells = scan.points_body[thin(scan.points_body, _CELL_M)]
    return float(np.median(np.linalg.norm(cells - scan.origin_body, axis=1)))


def _median_distance_m(log: Log) -> float | None:
    """Return the median over some scans; None if none of them can be read."""
    distances_m = []
    for index in spread_indices(len(log), _SCANS).tolist():
        try:
            scan = log.entry_at(index).scan()
        except FrameError:
            continue
        if len(scan.points_body):
            distances_m.append(spaciousness_m(scan))
    return float(np.median(distances_m)) if distances_m else None
