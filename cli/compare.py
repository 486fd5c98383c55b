"""``mapper compare``: every method on one log, side by side."""

from pathlib import Path
from typing import Annotated

import typer

from mapper.cli.answer import Answer, Output, record_in
from mapper.cli.console import files_text
from mapper.cli.options import First, Last, Overrides, Overwrite, Stride, assignments, merged, selection


def compare(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recorded log that mapper build can read.")],
    method: Annotated[
        list[str] | None,
        typer.Option("--method", help="Method to compare; repeatable. Omit for all that fit the log."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to create.")] = Path("compare"),
    pairs: Annotated[
        int | None, typer.Option(help="Pairs of frames to register; 0 for odometry alone.  [default: 30]")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the guesses' errors.")] = None,
    first: First = None,
    last: Last = None,
    stride: Stride = None,
    set_: Overrides = None,
    overwrite: Overwrite = False,
    *,
    output: Output,
) -> Answer:
    """Run every method over the same frames, as odometry and on pairs of frames with wrong guesses.

    If a comparison was stopped, the same command resumes it after the last finished method.

    Example: mapper compare rgbd_dataset_freiburg1_xyz --method isvd --method gicp --out runs/compared
    """
    from mapper.config.loading import overridden
    from mapper.evaluators.compare.config import CompareConfig
    from mapper.evaluators.compare.files import REPORT, compare_into
    from mapper.evaluators.compare.tables import tables_text
    from mapper.sources import open_source

    given = CompareConfig(methods=tuple(method or ()))
    short_options = [*selection(first, last, stride, None), *assignments({"pairs": pairs, "seed": seed})]
    config = overridden(given, merged(short_options, set_))
    source = open_source(log, config.source)
    comparison = compare_into(out, source, config, overwrite=overwrite, progress=output.progress())
    return Answer(record_in(out, REPORT), f"{tables_text(comparison)}\n{files_text(out)}")
