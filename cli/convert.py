"""``mapper convert``: a log in another format."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cli.console import progress_for
from cli.environment import prepare_libraries
from cli.options import First, Last, Quiet, RequireTruth, Stride, selection


class LogFormat(StrEnum):
    """A unified format."""

    TUM = "tum"
    MBAG = "mbag"


def convert(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recorded log that mapper build can read.")],
    out: Annotated[Path, typer.Option(help="Folder to create.")],
    as_: Annotated[LogFormat, typer.Option("--as", help="Format to write.")],
    first: First = None,
    last: Last = None,
    stride: Stride = None,
    require_truth: RequireTruth = None,
    quiet: Quiet = False,
) -> None:
    """Write a log in one of the unified formats; image files are copied byte for byte.

    Example: mapper convert 7scenes/chess/seq-01 --as tum --out logs/chess
    """
    from mapper.config import load_config
    from mapper.sources import open_source
    from mapper.sources.writers import write_log

    prepare_libraries()
    config = load_config(None, selection(first, last, stride, require_truth))
    source = open_source(log, config.source)
    progress = progress_for(quiet=quiet)
    with progress.stage("convert") as report:
        skipped = write_log(source, out, kind=as_.value, on_progress=lambda done: report(done, len(source)))
    for skip in skipped:
        progress.note(f"skipped: {skip.reason}")
    if not quiet:
        print(f"{out}: {len(source) - len(skipped)} frames as {as_.value}, {len(skipped)} skipped")
