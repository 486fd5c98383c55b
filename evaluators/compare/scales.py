"""Settings of the methods for scans, with their lengths scaled to a log's sensor."""

from typing import Any, get_args

from mapper.core.config import AnyConfig, with_changes
from mapper.core.frames import Sensor
from mapper.odometry.scans.config import KissOdometryConfig
from mapper.registration.config import VOXEL_M, RegistrationConfig
from mapper.registration.hough.config import HoughConfig

_INDOORS = 0.1
"""A depth camera sees 4 m where a LiDAR sees 40."""
_MAX_CAMERA_TILT_RAD = 1.05
"""A hand-held camera is tilted down to tables."""


def registrations_for(sensor: Sensor) -> list[Any]:
    """Return the settings of every registration of scans: its own for LiDARs, shrunk for depth cameras."""
    members: tuple[Any, ...] = get_args(get_args(RegistrationConfig)[0])
    return [_fitted(member(), sensor) for member in members]


def kiss_icp(sensor: Sensor) -> KissOdometryConfig:
    """Return KISS-ICP as published: without our checks of its answers."""
    published = KissOdometryConfig(rescue=None, usual_ratio=0.0, lost_ratio=0.0)
    return published if sensor == "lidar" else shrunk(published, _INDOORS)


def shrunk(config: AnyConfig, ratio: float) -> AnyConfig:
    """Return settings with every length, at any depth, at a part of its size."""

    def change(name: str, value: Any) -> Any:
        if not name.endswith("_m"):
            return value
        return tuple(ratio * v for v in value) if isinstance(value, tuple) else ratio * value

    return with_changes(config, change)


def _fitted(config: Any, sensor: Sensor) -> Any:
    if sensor == "lidar":
        return config
    if isinstance(config, HoughConfig):
        return _hough_indoors(config)
    return config.model_copy(update={"voxel_m": VOXEL_M[sensor]})  # its other lengths are multiples


def _hough_indoors(config: HoughConfig) -> HoughConfig:
    """Return the Hough methods shrunk, but for how high above the ground a sensor may stand."""
    heights = {"min_height_m", "max_height_m"}
    small = shrunk(config, _INDOORS)
    levelling = small.constellation.levelling.model_copy(
        update=config.constellation.levelling.model_dump(include=heights)
        | {"max_tilt_rad": _MAX_CAMERA_TILT_RAD}
    )
    constellation = small.constellation.model_copy(update={"levelling": levelling})
    return small.model_copy(update={"constellation": constellation})
