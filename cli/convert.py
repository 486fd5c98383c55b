"""``mapper convert``: a log in another format."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cli.console import progress_for
from cli.environment import prepare_libraries
from cli.options import First, Last, Overrides, Quiet, RequireTruth, Stride, merged, selection


class LogFormat(StrEnum):
    """A format to write."""

    TUM = "tum"
    MBAG = "mbag"
    KITTI = "kitti"
    MCAP = "mcap"
    BAG = "bag"


def convert(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recorded log that mapper build can read.")],
    out: Annotated[Path, typer.Option(help="Folder to create, or a file that ends in .mcap or .bag.")],
    as_: Annotated[LogFormat, typer.Option("--as", help="Format to write.")],
    first: First = None,
    last: Last = None,
    stride: Stride = None,
    require_truth: RequireTruth = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Write a log in another format; image files go over byte for byte where it has room for them.

    Example: mapper convert rgbd_dataset_freiburg1_xyz --as mcap --out xyz.mcap
    """
    from mapper.config.loading import load_source_config
    from mapper.sources import open_source
    from mapper.sources.reading_checks import ReadingChecks
    from mapper.sources.writers import left_out, write_log

    prepare_libraries()
    source = open_source(
        log, load_source_config(None, merged(selection(first, last, stride, require_truth), set_))
    )
    progress = progress_for(quiet=quiet)
    for note in (*source.notes, *left_out(source, as_.value)):
        progress.note(note)
    checks = ReadingChecks(source)
    with progress.stage("convert") as report:
        skipped = write_log(
            checks.log, out, kind=as_.value, on_progress=lambda done: report(done, len(source))
        )
    for note in (*(f"skipped: {skip.reason}" for skip in skipped), *checks.notes()):
        progress.note(note)
    if not quiet:
        print(f"{out}: {len(source) - len(skipped)} frames as {as_.value}, {len(skipped)} skipped")
