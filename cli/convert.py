"""``mapper convert`` and ``mapper export``: a log, or the files of a run, in another format."""

from pathlib import Path
from typing import Annotated, Literal, get_args

import typer

from mapper.cli.answer import Answer, Output, made
from mapper.cli.completion import export_kinds
from mapper.cli.options import (
    First,
    Last,
    MovedLogs,
    Overrides,
    Overwrite,
    RequireTruth,
    RunFolder,
    Stride,
    refuse_with,
    selection,
    settings_of,
)
from mapper.core.errors import ConfigError
from mapper.export.exporters import EXPORTERS, Frame
from mapper.runtime.result_paths import LOGS, name_of, place_of

LogFormat = Literal["tum", "mbag", "kitti", "mcap", "bag"]
_FILES: tuple[LogFormat, ...] = ("mcap", "bag")
_KINDS = "; ".join(f"{kind}: {exporter.summary}" for kind, exporter in EXPORTERS.items())


def convert(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recorded log that mapper build can read.")],
    as_: Annotated[
        LogFormat | None, typer.Option("--as", help="Format to write.  [default: by the ending of --out]")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to create, or a file that ends in .mcap or .bag.  [default: logs/LOG, or a number]"
        ),
    ] = None,
    first: First = None,
    last: Last = None,
    stride: Stride = None,
    require_truth: RequireTruth = None,
    set_: Overrides = None,
    *,
    output: Output,
) -> Answer:
    """Write a log in another format; image files are copied byte for byte where possible.

    Example: mapper convert rgbd_dataset_freiburg1_xyz --out xyz.mcap
    """
    from mapper.api.logs import open_log
    from mapper.sources.reading_checks import ReadingChecks
    from mapper.sources.writers import left_out, write_log

    if as_ is None:
        endings = {f".{name}": name for name in _FILES}
        as_ = endings.get("" if out is None else out.suffix)
    if as_ is None:
        formats = ", ".join(get_args(LogFormat))
        raise ConfigError(f"--as: want one of {formats}; an --out that ends in .mcap or .bag says it, too")
    settings = settings_of(selection(first, last, stride, require_truth), set_)
    source = open_log(log, settings=settings)
    ending = f".{as_}" if as_ in _FILES else ""
    out = place_of(out, LOGS / f"{name_of(log)}{ending}")
    progress = output.progress()
    for note in (*source.sentences, *left_out(source, as_)):
        progress.note(note)
    checks = ReadingChecks(source)
    with progress.stage("convert") as report:
        skipped = write_log(checks.log, out, kind=as_, on_progress=lambda done: report(done, len(source)))
    for note in (*(f"skipped: {skip.reason}" for skip in skipped), *(note for _, note in checks.notes())):
        progress.note(note)
    frames = len(source) - len(skipped)
    return Answer(
        {"path": out, "format": as_, "frames": frames, "skipped": len(skipped)},
        f"{out}: {frames} frames as {as_}, {len(skipped)} skipped",
    )


def export(
    run: RunFolder,
    as_: Annotated[
        str,
        typer.Option("--as", metavar="KIND", autocompletion=export_kinds, help=f"What to write. {_KINDS}."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="File to write; omit to keep it in RUN under its usual name.")
    ] = None,
    overwrite: Overwrite = False,
    level: Annotated[
        int | None,
        typer.Option(help="With --as octomap: levels of the tree to drop; each doubles the voxel size."),
    ] = None,
    frame: Annotated[
        Frame,
        typer.Option(
            help="Frame of poses and points: the map, or the body (start) or base_link at its first pose."
        ),
    ] = "map",
    poses_of: Annotated[
        str | None,
        typer.Option(
            metavar="FRAME",
            help="With --as tum, kitti: whose poses, base or a frame in the manifest.  [default: body]",
        ),
    ] = None,
    crop: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Write what lies in this box of the map, metres."),
    ] = None,
    set_: Overrides = None,
    log: MovedLogs = None,
    *,
    output: Output,
) -> Answer:
    """Write a run's map, cloud, surface, images, trajectory or graph for other programs, and print its path.

    For a merged map: octomap, grid, costmap, nav2, gis.

    Example: mapper export runs/xyz --as octomap --out xyz.ot, or: mapper export runs/xyz --as mesh
    """
    from mapper.export.exporters import export as export_run
    from mapper.merging import open_map_folder
    from mapper.run.folder import moved_log, open_run
    from mapper.run.map_folder import MapFolder

    if as_ != "octomap":
        refuse_with(f"--as {as_}", {"--level": level})
    built: MapFolder = moved_log(open_run(run), *log) if log else open_map_folder(run)
    path = export_run(
        built,
        as_,
        out,
        settings=settings_of({"octomap.level": level}, set_),
        frame=frame,
        poses_of=poses_of,
        box_m=crop,
        overwrite=overwrite,
        progress=output.progress(),
    )
    return made(path, kind=as_)
