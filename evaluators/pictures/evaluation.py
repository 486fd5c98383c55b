"""What was judged, as pictures."""

from pathlib import Path

import numpy as np

from evaluators.metrics.evaluate import Assessment, have_clock
from evaluators.metrics.occupancy import OccupancyCheck
from evaluators.pictures.map_agreement import write_agreement
from evaluators.pictures.path_errors import write_errors
from mapper.core.errors import DataError
from mapper.core.timebase import NS_PER_S

TRAJECTORY, MAP = "trajectory.png", "map.png"


def write_trajectory_errors(folder: Path, found: Assessment, *, title: str) -> Path:
    """Draw where, when and over which lengths a trajectory is wrong; return the picture.

    Args:
        folder: Gets ``trajectory.png``; made if it is not there.
        found: Assessment against a truth.
        title: Headline.

    Raises:
        DataError: There was no truth, or the folder cannot be made.
    """
    matched = found.matched
    if matched is None:
        raise DataError(f"{folder}: nothing to draw without a truth; tell one with --truth")
    picture = _made(folder) / TRAJECTORY
    timed = have_clock(matched.stamps_ns)
    elapsed = (matched.stamps_ns - matched.stamps_ns[0]).astype(np.float64)
    write_errors(
        picture,
        positions=matched.T_map_body[:, :3, 3],
        truth=matched.T_truth_body[:, :3, 3],
        elapsed=elapsed / NS_PER_S if timed else elapsed,
        elapsed_name="s" if timed else "poses",
        errors_m=matched.position_errors_m,
        errors_rad=matched.rotation_errors_rad,
        relative_percent={
            f"{length.length_m:g} m": 100.0 * length.translation_ratio
            for length in found.lengths
            if len(length)
        },
        title=title,
    )
    return picture


def write_map_errors(folder: Path, check: OccupancyCheck, *, title: str) -> Path:
    """Draw where a map and its reference agree, and where not; return the picture.

    Args:
        folder: Gets ``map.png``; made if it is not there.
        check: Of the map.
        title: Headline.

    Raises:
        DataError: The folder cannot be made.
    """
    picture = _made(folder) / MAP
    agreed, extra, missing = check.centres_world
    write_agreement(
        picture, agreed=agreed, extra=extra, missing=missing, edge_m=check.resolution_m, title=title
    )
    return picture


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made: {error.strerror}; want a folder for pictures") from None
    return folder
