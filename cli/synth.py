"""``mapper synth``: a synthetic log with exact truth."""

from pathlib import Path
from typing import Annotated

import typer

from cli.console import progress_for
from cli.environment import prepare_libraries
from cli.options import Quiet, assignments, merged


def synth(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="TUM folder to create.")],
    seconds: Annotated[float | None, typer.Option(help="Length of the log.")] = None,
    path: Annotated[str | None, typer.Option(help="loop, desk or spin.")] = None,
    rooms: Annotated[int | None, typer.Option(help="Rooms of the flat, an even number from 4.")] = None,
    noise: Annotated[float | None, typer.Option(help="Times a Kinect's noise; 0 is exact.")] = None,
    seed: Annotated[int | None, typer.Option(help="Another flat, another walk.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY.PATH=VALUE", help="Turn any other knob of the scene or sensor."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Ray-cast a walk through a furnished flat and write it as a TUM log with exact truth.

    Example: mapper synth logs/spin --path spin --seconds 10 --set sensor.exposure_s=0.01
    """
    from mapper.config import overridden
    from mapper.config.synthetic import SynthConfig
    from mapper.sources.synthetic import write_tum_log

    given = {
        "duration_s": seconds,
        "path": path,
        "rooms": rooms,
        "seed": seed,
        **_noise_knobs(noise),
    }
    config = overridden(SynthConfig(), merged(assignments(given), set_))
    prepare_libraries()
    with progress_for(quiet=quiet).stage("render") as report:
        write_tum_log(out, config, on_progress=report)
    if not quiet:
        print(f"{out}: a TUM log; map it with mapper build {out} --out RUN")


def _noise_knobs(noise: float | None) -> dict[str, float]:
    """Return every knob of the sensor's noise, scaled from its default."""
    from mapper.config.synthetic import SensorConfig

    if noise is None:
        return {}
    usual = SensorConfig()
    return {
        "sensor.axial_noise_ratio": noise,
        "sensor.lateral_noise_px": noise * usual.lateral_noise_px,
        "sensor.disparity_step_px": noise * usual.disparity_step_px,
        "sensor.image_noise_levels": noise * usual.image_noise_levels,
        "sensor.dropout_ratio": min(noise * usual.dropout_ratio, 1.0),
    }
