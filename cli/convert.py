"""``mapper convert``: a log in another format."""

from pathlib import Path
from typing import Annotated, Literal, get_args

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.options import First, Last, Overrides, RequireTruth, Stride, merged, selection
from mapper.core.errors import ConfigError
from mapper.runtime.result_paths import LOGS, name_of, place_of

LogFormat = Literal["tum", "mbag", "kitti", "mcap", "bag"]
_FILES: tuple[LogFormat, ...] = ("mcap", "bag")


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
    from mapper.config.loading import load_source_config
    from mapper.sources import open_source
    from mapper.sources.reading_checks import ReadingChecks
    from mapper.sources.writers import left_out, write_log

    if as_ is None:
        endings = {f".{name}": name for name in _FILES}
        as_ = endings.get("" if out is None else out.suffix)
    if as_ is None:
        formats = ", ".join(get_args(LogFormat))
        raise ConfigError(f"--as: want one of {formats}; an --out that ends in .mcap or .bag says it, too")
    selected = selection(first, last, stride, require_truth)
    source = open_source(log, load_source_config(None, merged(selected, set_)))
    ending = f".{as_}" if as_ in _FILES else ""
    out = place_of(out, LOGS / f"{name_of(log)}{ending}")
    progress = output.progress()
    for note in (*source.notes, *left_out(source, as_)):
        progress.note(note)
    checks = ReadingChecks(source)
    with progress.stage("convert") as report:
        skipped = write_log(checks.log, out, kind=as_, on_progress=lambda done: report(done, len(source)))
    for note in (*(f"skipped: {skip.reason}" for skip in skipped), *checks.notes()):
        progress.note(note)
    frames = len(source) - len(skipped)
    return Answer(
        {"path": out, "format": as_, "frames": frames, "skipped": len(skipped)},
        f"{out}: {frames} frames as {as_}, {len(skipped)} skipped",
    )
