"""Settings of `mapper register`."""

from typing import Any, get_args

from pydantic import Field

from mapper.core.config import Config
from mapper.core.errors import ConfigError
from mapper.core.frames import Sensor
from mapper.odometry.config import IsvdOdometryConfig
from mapper.registration.config import NEED_NO_GUESS, VOXEL_M, AnyRegistration
from mapper.registration.hough.config import HoughConfig, HoughGicpConfig
from mapper.sources.config import SourceConfig

_METHODS: dict[str, type[Config]] = {
    member.model_fields["kind"].default: member for member in (*get_args(AnyRegistration), IsvdOdometryConfig)
}


class RegisterConfig(Config):
    """All settings of ``mapper register``: how logs are opened, and the method."""

    source: SourceConfig = SourceConfig()
    registration: AnyRegistration | IsvdOdometryConfig = Field(HoughGicpConfig(), discriminator="kind")


def check_method(method: str, *, guess: str | None) -> None:
    """Check that there is a method of this name, and that it uses a guess if one is given.

    Raises:
        ConfigError: There is none, or it does not.
    """
    if method not in _METHODS:
        raise ConfigError(f"method {method}: want one of {', '.join(_METHODS)}")
    if guess is not None and method in {*NEED_NO_GUESS, "isvd"}:
        others = [name for name in _METHODS if name not in {*NEED_NO_GUESS, "isvd"}]
        raise ConfigError(f"guess: {method} has no use for one; leave it out, or choose {', '.join(others)}")


def register_config(method: str, *sensors: Sensor) -> RegisterConfig:
    """Return a known method's configuration, scaled to the range of the sensors that took the two frames.

    Raises:
        ConfigError: The method searches the ground, and a camera's frame has its z ahead.
    """
    member: Any = _METHODS[method]
    sensor: Sensor = "rgbd" if "rgbd" in sensors else "lidar"
    if sensor != "rgbd" or member is IsvdOdometryConfig:
        return RegisterConfig(registration=member())
    if issubclass(member, HoughConfig):
        others = [name for name, other in _METHODS.items() if not issubclass(other, HoughConfig)]
        raise ConfigError(
            f"method {method}: needs z up, and a camera's frame has it ahead; choose {', '.join(others)}"
        )
    return RegisterConfig(registration=member(voxel_m=VOXEL_M[sensor]))
