"""``mapper fuse``: a run's maps made again, without tracking."""

from pathlib import Path
from typing import Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.options import MovedLogs, Overrides, RunFolder


def fuse(
    run: RunFolder,
    set_: Overrides = None,
    log: MovedLogs = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="TUM file of better poses; only frames that moved are fused again.")
    ] = None,
    *,
    output: Output,
) -> Answer:
    """Make a run's maps again, for instance finer or with another slice, without tracking again.

    Octree, slice, cloud and MCAP settings can change; the old maps stay until the new ones are complete.

    Example: mapper fuse runs/xyz --set octree.resolution_m=0.1 --set slice.max_height_m=1.8
    """
    from mapper.cli.summary import summary_of
    from mapper.config.loading import overridden
    from mapper.pipeline.fuse import fuse as fuse_run
    from mapper.run.folder import moved_log, open_run
    from mapper.sources.trajectory_files import read_tum

    built = open_run(run)
    if log:
        built = moved_log(built, *log)
    config = overridden(built.config, set_ or ())
    return summary_of(
        fuse_run(
            built.open_log(),
            built,
            config,
            trajectory=None if trajectory is None else read_tum(trajectory),
            progress=output.progress(),
        )
    )
