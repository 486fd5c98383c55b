"""``mapper sensor``: how far a sensor's measurements can be trusted."""

import typer

from mapper.cli.answer import verb
from mapper.cli.groups import Verb, VerbGroup
from mapper.cli.sensor.depth import depth
from mapper.cli.sensor.line_laser import accuracy, calibrate, line_laser

sensor = typer.Typer(
    help="Measure a sensor's accuracy, and what its measurements become.",
    epilog="Example: mapper sensor depth LOG --plane-at 1.5 --out SENSOR",
    cls=VerbGroup,
    rich_markup_mode=None,
)
for _name, _function, _short in (
    ("depth", depth, "Measure a depth camera's errors and noise on planes"),
    ("line-laser", line_laser, "Range what a laser's stripe falls on in images"),
    ("line-laser-calibrate", calibrate, "Fit a line laser's laws to images of boards"),
    ("line-laser-accuracy", accuracy, "Measure how well each method finds the stripe"),
):
    sensor.command(_name, cls=Verb, short_help=_short)(verb(_function))
