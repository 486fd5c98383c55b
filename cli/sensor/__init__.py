"""``mapper sensor``: how far a sensor's measurements can be trusted."""

import typer

sensor = typer.Typer(
    help="Measure a sensor's accuracy, and what its measurements become.",
    epilog="Example: mapper sensor depth LOG --plane-at 1.5 --out SENSOR",
    no_args_is_help=True,
    rich_markup_mode=None,
)
