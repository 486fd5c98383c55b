"""What `mapper register` can be told."""

from typing import Any, get_args

from pydantic import Field

from mapper.config.base import Config
from mapper.config.hough import HoughGicpConfig
from mapper.config.odometry import IsvdOdometryConfig
from mapper.config.registration import VOXEL_M, AnyRegistration
from mapper.config.sensors import Sensor
from mapper.config.sources import SourceConfig
from mapper.errors import ConfigError

_METHODS: dict[str, type[Config]] = {
    member.model_fields["kind"].default: member for member in (*get_args(AnyRegistration), IsvdOdometryConfig)
}


class RegisterConfig(Config):
    """How logs are opened, and the method."""

    source: SourceConfig = SourceConfig()
    registration: AnyRegistration | IsvdOdometryConfig = Field(HoughGicpConfig(), discriminator="kind")


def register_config(method: str, sensor: Sensor) -> RegisterConfig:
    """Return a method's configuration, scaled to what a sensor sees.

    Raises:
        ConfigError: No such method.
    """
    if method not in _METHODS:
        raise ConfigError(f"--method {method}: want one of {', '.join(_METHODS)}")
    member: Any = _METHODS[method]
    return RegisterConfig(
        registration=member() if member is IsvdOdometryConfig else member(voxel_m=VOXEL_M[sensor])
    )
