"""``mapper merge``: many runs as one map, and the options for where the worlds of several runs lie."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.completion import run_folders
from mapper.cli.options import refuse_several, workers_for

if TYPE_CHECKING:
    from mapper.merging.merge import Merged
    from mapper.merging.merged_map import RunInMap

Place = Literal["built", "truth", "auto"]
"""Source of the poses of the runs' worlds in the map."""

PosesFile = Annotated[
    Path | None,
    typer.Option(
        "--poses", help="File of the worlds' poses in the map, one line per run: RUN tx ty tz qx qy qz qw."
    ),
]


def merge(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="[MAP] RUN…",
            autocompletion=run_folders,
            help="Run folders; after a merged map, they are added to it.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="MAP", help="Folder to create.  [default: maps/RUN+RUN…, or the map itself]"),
    ] = None,
    place: Annotated[
        Place | None,
        typer.Option(
            help="built: every run's world is the map's already. "
            "truth: the runs' truths share a frame. auto: by places that the runs share, in one pose graph; "
            "those that share none are left out. By truth and auto the first run's world is the map's.  "
            "[default: built; auto for a map that was placed so]"
        ),
    ] = None,
    poses: PosesFile = None,
    tile_m: Annotated[
        float, typer.Option(help="Approximate edge of a tile; a power of two in voxels.")
    ] = 50.0,
    processes: Annotated[
        int | None, typer.Option(help="Workers on this machine.  [default: 1]", show_default=False)
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="Dask scheduler whose workers see the same files."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing map.")] = False,
    *,
    output: Output,
) -> Answer:
    """Add up the octrees of many runs tile by tile, out of core: map.bt, map.ot, the slice and the tiles.

    With --place auto, runs bend where the others show that they drifted, and are fused again there from their
    logs; the run folders do not change. If a merge was stopped, the same command resumes it. Runs that are
    added to a map are searched in it, and tiles whose runs are unchanged stay.

    Example: mapper merge runs/monday runs/tuesday --out maps/campus --processes 2, or: mapper merge runs/*
    --out maps/city --place truth --scheduler tcp://10.0.0.1:8786
    """
    from mapper.api.merging import merge as merge_runs

    refuse_several({"--place": place, "--poses": poses})
    merged = merge_runs(
        runs,
        out=out,
        place=place,
        poses=poses,
        tile_m=tile_m,
        workers=workers_for(processes, scheduler, default=1),
        progress=output.progress(),
        overwrite=overwrite,
    )
    document = {
        "path": merged.map.path,
        "runs": merged.map.manifest.runs,
        "ties": merged.map.manifest.ties,
        "left_out": merged.map.manifest.left_out,
        "summary": merged.map.manifest.summary,
        "worker_s": {name: sum(cost.seconds for cost in of) for name, of in merged.costs.items()},
        "shuffle_bytes": merged.shuffle_bytes,
    }
    return Answer(document, _summary(merged))


def _bent(run: "RunInMap") -> str:
    from mapper.evaluators.study.table import MISSING

    if run.first_node is None:
        return MISSING
    return f"{run.moved_m:.2g} m" + (", fused again" if run.fused_again else "")


def _summary(merged: "Merged") -> str:
    from mapper.evaluators.study.table import MISSING, Column, text_table

    manifest = merged.map.manifest
    records = [{**run.model_dump(), "name": Path(run.path).name, "bent": _bent(run)} for run in manifest.runs]
    columns = [
        Column("name", "run"),
        Column("placed", "placed"),
        Column("bent", "bent"),
        Column("voxels", "voxels"),
        Column("shared_voxels", "known in both"),
        Column("agreement", "walls agree", lambda share: MISSING if share is None else f"{share:.0%}"),
    ]
    costs = merged.costs
    seconds = ", ".join(f"{name} {sum(cost.seconds for cost in of):.1f}" for name, of in costs.items())
    peak_mb = max(cost.peak_memory_mb for of in costs.values() for cost in of)
    lines = [
        text_table(columns, records),
        "",
        manifest.summary,
        f"workers' seconds: {seconds}; between them {merged.shuffle_bytes / 1e6:.1f} MB; "
        f"largest process {peak_mb:.0f} MB",
        str(merged.map.path),
    ]
    return "\n".join(lines)
