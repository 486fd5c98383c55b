"""Costmap: the inflated slice as files that nav2's map_server loads."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.export.grid import write_values
from mapper.export.palette import FREE_CELL, OCCUPIED_CELL, UNKNOWN_CELL
from mapper.navigation.costmap import INSCRIBED, LETHAL, NO_INFORMATION, Costmap, inflate
from mapper.octree.grid import with_obstacles
from mapper.run.map_folder import MapFolder
from mapper.runtime.atomic import write_bytes
from mapper.runtime.progress import Progress

_MOST_INFLATED = 98
_INSCRIBED, _LETHAL, _UNKNOWN = 99, 100, 255
_PICTURE_PX_PER_CELL = 4


def costmap(run: MapFolder, path: Path, _progress: Progress) -> None:
    """Write YAML in map_server's mode "raw" with PGM and PNG beside it.

    Raises:
        DataError: The configured radii do not fit together.
    """
    config = run.config.costmap
    inflated = inflate(
        with_obstacles(run.slice, run.keepout),
        robot_radius_m=config.robot_radius_m,
        inflation_radius_m=config.inflation_radius_m,
        cost_scaling=config.cost_scaling,
    )
    values = occupancy_values(inflated)
    write_bytes(path.with_suffix(".png"), _picture(values))
    write_values(path.parent, path.stem, values, inflated)


def occupancy_values(costmap: Costmap) -> NDArray[np.uint8]:
    """Return (H, W) values as nav2 publishes costs: 0 free, 1 … 98, 99 inscribed, 100 lethal, 255 unknown."""
    table = np.zeros(256, np.uint8)
    inflated = np.arange(1, INSCRIBED)
    table[1:INSCRIBED] = 1 + (_MOST_INFLATED - 1) * (inflated - 1) // (INSCRIBED - 2)
    table[[INSCRIBED, LETHAL, NO_INFORMATION]] = _INSCRIBED, _LETHAL, _UNKNOWN
    return table[costmap.costs]


def _picture(values: NDArray[np.uint8]) -> bytes:
    """Return a PNG: redder with the cost, obstacles dark, unknown grey."""
    share = np.clip(values, 0, _INSCRIBED).astype(np.float32)[..., None] / _INSCRIBED
    bgr = (1.0 - share) * FREE_CELL[::-1] + share * (40.0, 60.0, 225.0)
    bgr[values == _LETHAL] = OCCUPIED_CELL[::-1]
    bgr[values == _UNKNOWN] = UNKNOWN_CELL[::-1]
    enlarged = np.kron(bgr[::-1].astype(np.uint8), np.ones((_PICTURE_PX_PER_CELL,) * 2 + (1,), np.uint8))
    _, encoded = cv2.imencode(".png", enlarged)
    return encoded.tobytes()
