"""``mapper sensor line-laser`` and its calibration and accuracy."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.console import files_text
from mapper.cli.options import Overwrite, settings_of
from mapper.core.errors import RunError
from mapper.runtime.result_paths import RUNS, name_of, place_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mapper.core.geometry import Array
    from mapper.line_laser.calibration import CalibrationShot, Fit
    from mapper.line_laser.config import StripeConfig
    from mapper.line_laser.ranging import LineScan

_TABLE_2_1 = "table_2.1.csv"
_SHOWN = 3  # images whose detections are drawn

Knobs = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY.PATH=VALUE", help="stripe.edge_threshold, map.resolution_m, …"),
]


def line_laser(
    images: Annotated[Path, typer.Argument(metavar="IMAGES", help="Folder of images, stamped by name.")],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to create for ranges, grids, map and pictures.  [default: runs/IMAGES, or a number]"
        ),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="File of line-laser-calibrate.  [default: the thesis's sensor]")
    ] = None,
    wheels: Annotated[
        Path | None, typer.Option(help="encoders.txt or wheels.txt; without it there is no map.")
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(help="True stripes (image,column,row_px,range_m): print how accurate each method is."),
    ] = None,
    times: Annotated[
        Path | None, typer.Option(help="Stamps, one per line and image; otherwise from names or times.txt.")
    ] = None,
    set_: Knobs = None,
    overwrite: Overwrite = False,
    *,
    output: Output,
) -> Answer:
    """Measure the ranges of a laser's stripe in images.

    With wheel readings, make a map as well.

    Example: mapper sensor line-laser drive/images --calibration C.toml --wheels drive/encoders.txt --out seen
    """
    from mapper.config.loading import overridden, read_config
    from mapper.evaluators.sensors.line_laser import read_labels, score
    from mapper.line_laser.config import THESIS, LineLaserCalibration, LineLaserConfig
    from mapper.line_laser.files import FOLDER, find_images, write_drive, write_scans
    from mapper.line_laser.survey import drive, scan_images, sensor_poses
    from mapper.runtime.atomic import atomic_folder

    out = place_of(out, RUNS / name_of(images), overwrite=overwrite)
    progress = output.progress()
    config = overridden(LineLaserConfig(), set_ or [])
    known = read_config(calibration, LineLaserCalibration) if calibration else THESIS
    paths, stamps_ns, notes = find_images(images, times=times, rate_hz=config.rate_hz)
    truth = read_labels(labels, images=paths, width_px=known.width_px) if labels else {}
    T_world_sensor = None
    if wheels is not None:
        T_world_sensor, more = sensor_poses(wheels, known)
        notes += more
    with atomic_folder(out, FOLDER, overwrite=overwrite) as folder:
        scans, more = scan_images(paths, stamps_ns, known, config, progress=progress)
        notes += more
        if T_world_sensor is not None:
            driven = drive(list(scans.values()), T_world_sensor, config.map, progress=progress)
            notes += driven.notes
            write_drive(folder, driven, title=out.resolve().name)
        write_scans(folder, scans, calibration=known, config=config, notes=notes)
        _draw(folder, list(scans), config.stripe, truth)
        scores = score(scans, truth, config.stripe) if truth else None
        if scores is not None:
            scores.write(folder)
    for note in notes:
        progress.note(note)
    text = f"{_summary(scans)}\n{files_text(out, width=9)}"
    document = {"path": out, "images": len(scans), **_counts(scans)}
    return Answer(document, text if scores is None else f"{scores.text}\n\n{text}")


def calibrate(
    shots: Annotated[
        Path,
        typer.Argument(
            metavar="SHOTS", help="CSV of image,range_m,width_m, or a folder with such a shots.csv."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Calibration file to create, and a picture beside it.  [default: line-laser.toml]"),
    ] = None,
    reach: Annotated[float, typer.Option(help="Distance ahead at which the laser meets the floor, m.")] = 1.9,
    wheelbase: Annotated[float | None, typer.Option(help="Between the vehicle's axles, m.")] = None,
    sensor_x: Annotated[
        float, typer.Option(help="Distance from the rear axle ahead to the origin of ranges, m.")
    ] = 0.0,
    set_: Knobs = None,
    overwrite: Overwrite = False,
    *,
    output: Output,
) -> Answer:
    """Fit a line laser's range and lateral laws to images of boards.

    The boards face the sensor at known distances; two or more have known widths.

    Example: mapper sensor line-laser-calibrate drive/shots --wheelbase 0.26 --sensor-x 0.2 --out C.toml
    """
    from mapper.config.loading import overridden
    from mapper.evaluators.pictures.line_laser import write_calibration_picture
    from mapper.line_laser.calibration import calibrate as fit_laws
    from mapper.line_laser.calibration import calibration_text
    from mapper.line_laser.config import LineLaserConfig, VehicleConfig
    from mapper.line_laser.files import read_shots
    from mapper.runtime.atomic import refuse_existing, write_text

    out = place_of(out, Path("line-laser.toml"), overwrite=overwrite)
    picture = out.with_suffix(".png")
    if picture == out:
        raise RunError(f"{out}: the picture's place; want an --out that ends in .toml")
    for path in (out, picture):
        refuse_existing(path, overwrite=overwrite)
    vehicle = overridden(
        VehicleConfig(), settings=settings_of({"wheelbase_m": wheelbase, "sensor_x_m": sensor_x})
    )
    progress = output.progress()
    config = overridden(LineLaserConfig(), set_ or [])
    seen, size_px, notes = read_shots(shots, config.stripe, progress=progress)
    for note in notes:
        progress.note(note)
    fit = fit_laws(seen, size_px=size_px, reach_m=reach, vehicle=vehicle)
    write_text(out, calibration_text(fit.calibration))
    write_calibration_picture(picture, fit, seen)
    return Answer(
        {"path": out, "picture": picture, "calibration": fit.calibration},
        f"{_laws(fit, seen)}\nin       {out}, {picture.name}",
    )


def accuracy(
    seeds: Annotated[int, typer.Option(min=1, help="How many rooms to render.")] = 3,
    out: Annotated[Path | None, typer.Option(help="Folder to create for both tables as CSV.")] = None,
    set_: Knobs = None,
    overwrite: Overwrite = False,
    *,
    output: Output,
) -> Answer:
    """Print how well each method finds the stripe in rendered rooms.

    The rooms have lamps, red objects and noise. The thesis's Table 2.1 is measured again, too.

    Example: mapper sensor line-laser-accuracy --seeds 5 --set stripe.edge_threshold=100
    """
    from contextlib import nullcontext

    from mapper.config.loading import overridden
    from mapper.evaluators.sensors.line_laser_study import detections, study, table_2_1
    from mapper.evaluators.study.table import csv_text
    from mapper.line_laser.config import LineLaserConfig
    from mapper.line_laser.files import DETECTIONS
    from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, atomic_folder, write_text

    config = overridden(LineLaserConfig(), set_ or [])
    tables = FolderKind(
        "a line laser's accuracy",
        manifest_keys=frozenset(LineLaserConfig.model_fields),
        files=frozenset({DETECTIONS, _TABLE_2_1}),
    )
    with atomic_folder(out, tables, overwrite=overwrite) if out else nullcontext() as folder:
        found = study(config, range(seeds), progress=output.progress())
        scenes, ranges = detections(found), table_2_1(found)
        if folder is not None:
            write_text(folder / DETECTIONS, csv_text(scenes.records))
            write_text(folder / _TABLE_2_1, csv_text(ranges.records))
            write_text(folder / MANIFEST_NAME, config.model_dump_json(indent=1) + "\n")
    document = {"path": out, "detections": scenes.records, "ranges": ranges.records}
    return Answer(document, f"{scenes.text()}\n\n{ranges.text()}")


def _draw(
    folder: Path,
    paths: "Sequence[Path]",
    config: "StripeConfig",
    labels: "Mapping[str, tuple[Array, Array]]",
) -> None:
    from mapper.evaluators.pictures.line_laser import write_detections
    from mapper.sources.image_files.reading import read_colour

    for place in sorted({k * (len(paths) - 1) // (_SHOWN - 1) for k in range(_SHOWN)}):
        path = paths[place]
        true_rows, _ = labels.get(path.name, (None, None))
        picture = folder / f"detection_{path.stem}.png"
        write_detections(picture, read_colour(path), config, title=path.name, true_rows=true_rows)


def _summary(scans: "Mapping[Path, LineScan]") -> str:
    counts = _counts(scans)
    return (
        f"stripe   {len(scans)} images, {counts['columns']} columns with a stripe, "
        f"{counts['floor_columns']} of them on the floor"
    )


def _counts(scans: "Mapping[Path, LineScan]") -> dict[str, int]:
    return {
        "columns": sum(len(scan.columns) for scan in scans.values()),
        "floor_columns": sum(int(scan.is_floor.sum()) for scan in scans.values()),
    }


def _laws(fit: "Fit", shots: "Sequence[CalibrationShot]") -> str:
    import numpy as np

    law, lateral = fit.calibration.range, fit.calibration.lateral
    sigmas = [np.sqrt(np.diag(c)) if c else np.full(2, np.nan) for c in (law.covariance, lateral.covariance)]
    lines = [
        f"range    {law.scale_mm:.0f} · p^{law.exponent:.4f} mm, "
        f"σ {law.scale_mm * sigmas[0][0]:.0f} mm and {sigmas[0][1]:.4f}",
        f"lateral  x / ({lateral.slope:.5f} y {lateral.offset:+.4f}) cm, "
        f"σ {sigmas[1][0]:.5f} and {sigmas[1][1]:.4f}",
        "",
        "range m   row px   off by mm",
    ]
    lines += [
        f"{shot.range_m:7.3f} {shot.board.row_px:8.2f} {1e3 * error_m:+11.1f}"
        for shot, error_m in zip(shots, fit.range_errors_m, strict=True)
    ]
    widths_mm = 1e3 * fit.width_errors_m
    return "\n".join([*lines, "", f"widths   off by {np.sqrt((widths_mm**2).mean()):.1f} mm (RMS)"])
