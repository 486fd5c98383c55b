"""``mapper sensor``: how far a sensor's measurements can be trusted."""

import typer

from cli.sensor.depth import depth
from cli.sensor.line_laser import accuracy, calibrate, line_laser

sensor = typer.Typer(
    help="Measure a sensor's accuracy, and what its measurements become.",
    epilog="Example: mapper sensor depth LOG --plane-at 1.5 --out SENSOR",
    no_args_is_help=True,
    rich_markup_mode=None,
)
sensor.command("depth")(depth)
sensor.command("line-laser")(line_laser)
sensor.command("line-laser-calibrate")(calibrate)
sensor.command("line-laser-accuracy")(accuracy)
