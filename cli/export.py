"""``mapper export``: one file of a run, in the format that another program reads."""

from pathlib import Path
from typing import Annotated

import typer

from mapper.cli.answer import Answer, Output, made
from mapper.cli.completion import export_kinds
from mapper.cli.options import MovedLogs, Overrides, Overwrite, RunFolder, assignments, merged, refuse_with
from mapper.export.exporters import EXPORTERS

_KINDS = "; ".join(f"{kind}: {exporter.summary}" for kind, exporter in EXPORTERS.items())


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
    set_: Overrides = None,
    log: MovedLogs = None,
    *,
    output: Output,
) -> Answer:
    """Write a run's map, cloud, surface, images, trajectory or graph for other programs, and print its path.

    For a merged map: octomap, grid, costmap, nav2, gis.

    Example: mapper export runs/xyz --as octomap --out xyz.ot, or: mapper export runs/xyz --as mesh
    """
    from mapper.config.loading import overridden
    from mapper.export.exporters import export as export_run
    from mapper.merging import open_map_folder
    from mapper.run.folder import moved_log, open_run
    from mapper.run.map_folder import MapFolder

    if as_ != "octomap":
        refuse_with(f"--as {as_}", {"--level": level})
    built: MapFolder = moved_log(open_run(run), *log) if log else open_map_folder(run)
    changes = merged(assignments({"octomap.level": level}), set_)
    config = overridden(built.config, changes) if changes else None
    progress = output.progress()
    path = export_run(built, as_, out, config=config, overwrite=overwrite, progress=progress)
    return made(path, kind=as_)
