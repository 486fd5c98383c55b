"""``mapper diff``: what changed between two runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output, record_in
from mapper.cli.completion import run_folders
from mapper.cli.merge import Place, PosesFile
from mapper.cli.options import refuse_several
from mapper.runtime.result_paths import DIFFS, joined_names, place_of

if TYPE_CHECKING:
    from mapper.merging.differences import Differences

_LISTED = 10


def diff(
    before: Annotated[
        Path,
        typer.Argument(
            metavar="RUN_A", autocompletion=run_folders, help="Run folder of the earlier session."
        ),
    ],
    after: Annotated[
        Path,
        typer.Argument(metavar="RUN_B", autocompletion=run_folders, help="Run folder of the later session."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Folder to create.  [default: diffs/RUN_A+RUN_B]"),
    ] = None,
    place: Annotated[
        Place | None,
        typer.Option(
            help="built: both runs have one world, as sessions of a chain have. "
            "truth: the runs' truths share a frame. auto: by places that both have seen.  [default: auto]"
        ),
    ] = None,
    poses: PosesFile = None,
    tolerance_m: Annotated[
        float | None,
        typer.Option(help="Surfaces closer than this are the same, metres.  [default: two voxels]"),
    ] = None,
    min_voxels: Annotated[int, typer.Option(help="Smaller clusters are counted, not listed.", min=1)] = 8,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FOLDER.")] = False,
    *,
    output: Output,
) -> Answer:
    """Compare the maps of two runs: what appeared, what vanished, and what was not seen again.

    Only space that both runs have measured is compared. FOLDER gets a list, a picture and clouds.

    Example: mapper diff runs/monday runs/tuesday --out diffs/tuesday
    """
    from mapper.api.merging import diff as diff_runs
    from mapper.merging.differences import summary
    from mapper.run.folder import open_run

    refuse_several({"--place": place, "--poses": poses})
    earlier, later = open_run(before), open_run(after)
    out = place_of(out, DIFFS / joined_names([before, after]), overwrite=overwrite)
    found = diff_runs(
        earlier,
        later,
        out=out,
        place=place,
        poses=poses,
        tolerance_m=tolerance_m,
        min_voxels=min_voxels,
        progress=output.progress(),
        overwrite=overwrite,
    )
    record = record_in(out)
    table = _table(found, earlier.config.octree.resolution_m)
    return Answer(record, f"{summary(found)}\nplaced {record['placed']}\n{table}\n{out}")


def _table(found: "Differences", resolution_m: float) -> str:
    from mapper.evaluators.study.table import Column, Record, text_table

    records: list[Record] = [
        {
            "what": what,
            "centre": ", ".join(f"{value:.2f}" for value in cluster.centre_world),
            "size": " × ".join(f"{value:.2f}" for value in cluster.size_m(resolution_m)),
            "voxels": len(cluster.centres_world),
        }
        for what, clusters in (("appeared", found.appeared), ("vanished", found.vanished))
        for cluster in clusters[:_LISTED]
    ]
    columns = [
        Column("what", ""),
        Column("centre", "centre, m"),
        Column("size", "size, m"),
        Column("voxels", "voxels"),
    ]
    return text_table(columns, records)
