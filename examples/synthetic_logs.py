"""Small logs that the toolkit simulates, with exact truth, so that the examples need no download."""

import tempfile
from pathlib import Path

from mapper.simulation import write_tum_log
from mapper.simulation.config import STREET, LidarSensorConfig, SynthConfig
from mapper.simulation.lidar import write_lidar_log


def scratch() -> Path:
    """Return a new folder that is kept, for logs and runs."""
    return Path(tempfile.mkdtemp(prefix="mapper-"))


def room_log(folder: Path) -> Path:
    """Write two seconds of a hand-held RGB-D camera in a room, as a TUM folder."""
    log = folder / "room"
    write_tum_log(
        log, SynthConfig(path="desk", duration_s=2.0, frame_rate_hz=15.0, width_px=320, height_px=240)
    )
    return log


def street_log(folder: Path) -> Path:
    """Write two seconds of a LiDAR on a car in a street, as a KITTI folder."""
    log = folder / "street"
    sensor = LidarSensorConfig(rings=32, azimuth_steps=720)
    write_lidar_log(log, STREET.model_copy(update={"duration_s": 2.0, "sensor": sensor}))
    return log
