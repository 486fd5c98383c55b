"""``mapper register``: the motion between two clouds."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.console import files_text
from mapper.cli.options import Overrides
from mapper.core.errors import RegistrationError
from mapper.runtime.atomic import refuse_existing

if TYPE_CHECKING:
    from mapper.core.frames import Scan, Sensor
    from mapper.evaluators.compare.registration import Registered

_CLOUD = "A cloud (.bin .pcd .ply .npy .las .laz, text as .xyz), or LOG@N: the n-th frame of a log, from 0."


def register(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help=f"What is aligned. {_CLOUD}")],
    target: Annotated[
        str, typer.Argument(metavar="TARGET", help="What it is aligned to: the same, or a map.")
    ],
    method: Annotated[
        str,
        typer.Option(
            help="hough-gicp or hough-ndt for scans with z up; icp, plane-icp, gicp, ndt, kiss-matcher; "
            "isvd for images."
        ),
    ] = "hough-gicp",
    guess: Annotated[
        str | None,
        typer.Option(
            metavar="POSE",
            help='Where the source is in the target: "x y z roll pitch yaw" in m and °, or a file with a 4×4 '
            "matrix or a TUM line. For the four that refine one.  [default: the same place]",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to create for the cloud, picture and recording.")
    ] = None,
    rerun: Annotated[
        str | None,
        typer.Option(metavar="TARGET", help="Show it in Rerun: FILE.rrd, spawn or connect[:URL]."),
    ] = None,
    set_: Overrides = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT, and the .rrd file.")] = False,
    *,
    output: Output,  # noqa: ARG001
) -> Answer:
    """Register two clouds; the exit status is 1 if the result is not to be trusted.

    Example: mapper register scan_10.bin scan_00.bin --method hough-gicp --out registered
    """
    from mapper.api.logs import read_frame
    from mapper.api.register import parse_guess
    from mapper.config.loading import load_source_config, overridden
    from mapper.config.register import check_method, register_config
    from mapper.evaluators.compare.registration import (
        FOLDER,
        registration_record,
        registration_text,
        write_registration,
    )
    from mapper.evaluators.compare.registration import register as register_frames
    from mapper.runtime.atomic import atomic_folder

    if rerun is not None:
        from mapper.export.rerun.target import check_target

        refuse_existing(Path(check_target(rerun)), overwrite=overwrite, option="--rerun")
    check_method(method, guess=guess)
    T_target_source = parse_guess(guess)
    overrides = set_ or []
    opening = load_source_config(None, overrides)
    target_frame, target_sensor = read_frame(target, opening)
    source_frame, source_sensor = read_frame(source, opening)
    config = overridden(register_config(method, target_sensor, source_sensor), overrides)
    registered = register_frames(target_frame, source_frame, config.registration, T_target_source)
    text = registration_text(registered)
    if out is not None:
        with atomic_folder(out, FOLDER, overwrite=overwrite) as folder:
            write_registration(
                folder,
                registered,
                target=target_frame.scan(),
                source=source_frame.scan(),
                names=(target, source),
                sensor=target_sensor,
                config=config,
            )
        text = f"{text}\n{files_text(out, width=9)}"
    if rerun is not None:
        name = f"{source} on {target}"
        _shown(rerun, registered, target_frame.scan(), source_frame.scan(), name, target_sensor)
    error = None
    if not registered.alignment.converged:
        error = RegistrationError(f"{source} on {target}: not trusted: {registered.alignment.reason}")
    document = {**registration_record(registered), "target": target, "source": source, "path": out}
    return Answer(document, text, error=error)


def _shown(
    rerun: str, registered: "Registered", target: "Scan", source: "Scan", name: str, sensor: "Sensor"
) -> None:
    from mapper.export.rerun.finished import record_registration

    stages = [
        (f"{stage.name}: MPD {stage.distance.mpd_m:.3f} m", stage.T_target_source)
        for stage in registered.stages
    ]
    record_registration(rerun, target.points_body, source.points_body, stages, sensor=sensor, name=name)
