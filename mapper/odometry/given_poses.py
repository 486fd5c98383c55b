"""Known poses as an odometry: those of a file, the log's own truth, or its device's."""

from pathlib import Path

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.errors import ConfigError
from mapper.core.timebase import NS_PER_S, seconds_text_from_ns
from mapper.core.trajectory import Trajectory, with_rotations
from mapper.odometry.config import GivenOdometryConfig, OdometryConfig
from mapper.odometry.wheel_odometry import WheelsOdometry
from mapper.sources.base import Log
from mapper.sources.trajectory_files import read_tum


class GivenOdometry(WheelsOdometry):
    """Odometry of either sensor's frames by known poses, interpolated to their stamps.

    As by wheels, keyframes are the nodes, and in a gap of the poses or outside their time frames are lost.
    """

    method = "given"
    readings = "the given poses"

    def _twist(self, stamp_ns: int) -> Twist | None:
        """Return how the body moves at a time; None where poses are too sparse for that, as of keyframes."""
        stamps_ns = self._wheels.stamps_ns
        index = int(np.searchsorted(stamps_ns, stamp_ns))
        span_ns = int(np.ptp(stamps_ns[max(index - 1, 0) : index + 2]))
        return super()._twist(stamp_ns) if span_ns <= 2 * self._config.max_gap_s * NS_PER_S else None


def poses_for(config: OdometryConfig, log: Log) -> Trajectory | None:
    """Return the poses that an odometry takes over: known ones if it is of that kind, else the wheels'.

    Raises:
        ConfigError: The file of known poses does not exist, or none of its poses is of the log's time.
        DataError: The file is malformed.
    """
    if not isinstance(config, GivenOdometryConfig):
        return log.wheels
    if config.path is None:
        return log.device_poses if (truth := with_rotations(log.truth)) is None else truth
    path = _found(config.path, log)
    poses = read_tum(path)
    if with_rotations(poses) is None:
        raise ConfigError(f"{path}: positions alone; odometry.kind=given needs rotations, qx qy qz qw, too")
    (first_ns, last_ns), (begin_ns, end_ns) = poses.stamps_ns[[0, -1]], log.stamps_ns[[0, -1]]
    if last_ns < begin_ns or first_ns > end_ns:
        given, frames = (
            " to ".join(map(seconds_text_from_ns, span)) for span in ((first_ns, last_ns), (begin_ns, end_ns))
        )
        raise ConfigError(f"{path}: poses from {given} s, but the log's frames are from {frames} s")
    return poses


def _found(path: Path, log: Log) -> Path:
    folder = log.path if log.path.is_dir() else log.path.parent
    found = next((place for place in (path, folder / path) if place.is_file()), None)
    if found is None:
        raise ConfigError(f"{path}: no such file, nor in {folder} (odometry.path)")
    return found
