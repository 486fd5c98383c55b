"""``mapper config``: every setting with its value."""

from enum import StrEnum
from typing import Annotated

import typer

from cli.answer import Answer, Output
from cli.options import ConfigFile, Overrides


class SensorName(StrEnum):
    """Sensor whose defaults are shown."""

    RGBD = "rgbd"
    LIDAR = "lidar"


def show_config(
    config: ConfigFile = None,
    set_: Overrides = None,
    sensor: Annotated[SensorName, typer.Option(help="Whose defaults to begin with.")] = SensorName.RGBD,
    *,
    output: Output,  # noqa: ARG001
) -> Answer:
    """Print every setting that a build with these options would use, as JSON.

    Example: mapper config --set odometry.kind=isvd > isvd.json, then: mapper build LOG --config isvd.json
    """
    from mapper.config.loading import load_config

    loaded = load_config(config, set_ or (), sensor=sensor.value)
    return Answer(loaded.model_dump(mode="json"), loaded.model_dump_json(indent=2))
