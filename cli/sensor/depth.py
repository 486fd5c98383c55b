"""``mapper sensor depth``: a depth camera's errors and noise."""

import math
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.options import First, Last, Overrides, Overwrite, Stride, refuse_with, selection, settings_of
from mapper.core.errors import ConfigError

if TYPE_CHECKING:
    from mapper.evaluators.sensors.depth_accuracy import Patch

_FITTED_FRAMES = 100


def depth(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG", help="RGB-D logs of one camera that mapper build can read.")
    ],
    plane_at: Annotated[
        list[float] | None,
        typer.Option(
            metavar="METRES", help="Distance of the plane in each LOG; once per log, in their order."
        ),
    ] = None,
    fit_plane: Annotated[
        bool,
        typer.Option("--fit-plane", help="Use any planes that the logs show, in about 100 frames of each."),
    ] = False,
    patch: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN,ROW,WIDTH,HEIGHT",
            help="Where in the image to look, pixels.  [default: the middle third; everywhere to fit planes]",
        ),
    ] = None,
    keep_tilt: Annotated[
        bool,
        typer.Option("--keep-tilt", help="Count a plane's tilt against the camera's axis as an error."),
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder to create: sensor.toml, numbers and pictures.")
    ] = None,
    first: First = None,
    last: Last = None,
    stride: Stride = None,
    set_: Overrides = None,
    overwrite: Overwrite = False,
    *,
    output: Output,
) -> Answer:
    """Measure a depth camera's errors and noise on planes.

    Largest error and noise, before and after the depth filter DIF, and a noise model for mapper build.

    Example: mapper sensor depth wall-0.8 wall-1.6 --plane-at 0.8 --plane-at 1.6 --out kinect, or: mapper
    sensor depth rgbd_dataset_freiburg1_xyz --fit-plane --out kinect, then: mapper build LOG --out RUN
    --config kinect/sensor.toml
    """
    from mapper.config.loading import load_config
    from mapper.evaluators.pictures.depth_camera import FOLDER, SENSOR, write_depth_study
    from mapper.evaluators.sensors.depth_study import depth_text, records_of, study_depth
    from mapper.runtime.atomic import atomic_folder
    from mapper.sources import open_source

    distances_m = _distances(logs, plane_at, fit_plane=fit_plane, keep_tilt=keep_tilt)
    where = None if patch is None else _patch(patch)
    config = load_config(settings_of(selection(first, last, stride, None), set_)).source
    sources = [open_source(log, config) for log in logs]
    with nullcontext() if out is None else atomic_folder(out, FOLDER, overwrite=overwrite) as folder:
        study = study_depth(
            sources,
            distances_m,
            patch=where,
            keep_tilt=keep_tilt,
            most_frames=_FITTED_FRAMES if stride is None else None,
            progress=output.progress(),
        )
        if folder is not None:
            write_depth_study(folder, study)
    text = depth_text(study)
    if out is not None:
        text += f"\n\nin     {out}; use it with mapper build LOG --config {out / SENSOR}"
    return Answer({"path": out, "noise": study.fit.noise, "levels": records_of(study)}, text)


def _distances(
    logs: Sequence[Path], plane_at: list[float] | None, *, fit_plane: bool, keep_tilt: bool
) -> Sequence[float] | None:
    if fit_plane:
        refuse_with(
            "--fit-plane, which finds distance and tilt", {"--plane-at": plane_at, "--keep-tilt": keep_tilt}
        )
        return None
    if not plane_at:
        raise ConfigError(
            "give the distance of each LOG's plane with --plane-at, or search for planes with --fit-plane"
        )
    if len(plane_at) != len(logs):
        raise ConfigError(f"{len(logs)} logs and {len(plane_at)} --plane-at; want one for each log")
    for distance_m in plane_at:
        if not 0.0 < distance_m < math.inf:
            raise ConfigError(f"--plane-at {distance_m:g}: want metres before the camera, more than 0")
    return plane_at


def _patch(text: str) -> "Patch":
    from mapper.evaluators.sensors.depth_accuracy import Patch

    try:
        column, row, width, height = (int(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(f"--patch {text}: want four whole numbers: COLUMN,ROW,WIDTH,HEIGHT") from None
    return Patch(column, row, width, height)
