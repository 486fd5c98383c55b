"""``mapper build``: a log becomes a run."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output, untrusted
from mapper.cli.completion import run_folders
from mapper.cli.environment import note_compilation
from mapper.cli.option_rules import refuse_with, refuse_without
from mapper.cli.options import (
    ConfigFile,
    First,
    Last,
    Overrides,
    Overwrite,
    RequireTruth,
    Stride,
    merged,
    selection,
)
from mapper.cli.stepping import Stepping
from mapper.core.errors import ViewerError
from mapper.runtime.result_paths import RUNS, name_of, place_of

if TYPE_CHECKING:
    from mapper.config.build import BuildConfig
    from mapper.evaluators.metrics.metric import Metric
    from mapper.run.folder import Run
    from mapper.run.observers import Observer
    from mapper.runtime.progress import Progress
    from mapper.sources.base import Log

    ObserverFactory = Callable[[Log, BuildConfig], AbstractContextManager[Observer]]


def build(
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG",
            help="Recorded log: a folder (TUM, Poznań, KITTI, numbered, clouds), .mcap, .bag or .mbag.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Run folder to create.  [default: runs/LOG, or with a number]")
    ] = None,
    config: ConfigFile = None,
    set_: Overrides = None,
    first: First = None,
    last: Last = None,
    stride: Stride = None,
    require_truth: RequireTruth = None,
    onto: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            autocompletion=run_folders,
            help="Append the log to this run of the same place; OUT then holds both, by RUN's own settings.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Start again; otherwise a stopped build is resumed.")
    ] = False,
    rerun: Annotated[
        str | None,
        typer.Option(metavar="FILE.rrd|spawn|connect[:URL]", help="Show the build in Rerun while it runs."),
    ] = None,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="Exit with status 1 if the run is not trusted; it is written in any case."
        ),
    ] = False,
    step: Annotated[
        bool, typer.Option("--step", help="With --rerun: wait for Enter after each frame.")
    ] = False,
    *,
    output: Output,
) -> Answer:
    """Turn a recorded log into a pose graph, an octree map, a 2D slice and an MCAP log.

    Example: mapper build rgbd_dataset_freiburg1_xyz --set octree.resolution_m=0.1
    """
    out = place_of(out, RUNS / name_of(log), overwrite=overwrite)
    overrides = merged(selection(first, last, stride, require_truth), set_)
    make_observer = observer_factory(rerun, step=step, overwrite=overwrite)
    if onto is None:
        run, metrics = built(
            log,
            config,
            overrides,
            out,
            overwrite=overwrite,
            fresh=fresh,
            output=output,
            prompts=step,
            make_observer=make_observer,
        )
    else:
        refuse_with("--onto", {"--config": config}, remedy="give single settings by --set")
        refuse_with("--onto", {"--rerun": rerun}, remedy="look at the new run with mapper view")
        refuse_with("--onto", {"--fresh": fresh})
        run, metrics = appended(log, onto, overrides, out, overwrite=overwrite, output=output)
    from mapper.cli.summary import summary_of  # a build begins without what its end needs

    error = untrusted(run.path, run.verdict) if strict else None
    return replace(summary_of(run, metrics), error=error)


def built(
    log: Path,
    config_file: Path | None,
    overrides: "Sequence[str]",
    out: Path,
    *,
    overwrite: bool,
    output: Output,
    fresh: bool = False,
    prompts: bool = False,
    make_observer: "ObserverFactory | None" = None,
) -> "tuple[Run, Sequence[Metric]]":
    """Build a run and judge its trajectory by the truth, if the log has any."""
    from mapper.config.loading import load_config, load_source_config
    from mapper.pipeline.build import build as build_run
    from mapper.run.observers import Observers
    from mapper.sources import open_source

    source = open_source(log, load_source_config(config_file, overrides))
    config = load_config(config_file, overrides, sensor=source.sensor)
    progress = output.progress(prompts=prompts)
    note_compilation(progress)
    for note in source.notes:
        progress.note(note)
    preview = _preview(source, out, progress)
    with nullcontext(preview) if make_observer is None else make_observer(source, config) as observer:
        watching = preview if make_observer is None else Observers(observer, preview)
        run = build_run(
            source, config, out, progress=progress, observer=watching, overwrite=overwrite, fresh=fresh
        )
    from mapper.evaluators.metrics.evaluate import evaluate

    return run, evaluate(run.trajectory, run.truth).metrics


def _preview(source: "Log", out: Path, progress: "Progress") -> "Observer":
    """Return the observer that keeps a picture among the files that are being written."""
    from mapper.export.preview import PREVIEW, Preview
    from mapper.runtime.atomic import partial_of

    shown = partial_of(out) / PREVIEW
    return Preview(shown.resolve(), source, on_first=lambda: progress.note(f"first picture: {shown}"))


def observer_factory(rerun: str | None, *, step: bool, overwrite: bool) -> "ObserverFactory | None":
    """Return the observer of a build, refusing at once what would fail at its end."""
    if rerun is None:
        refuse_without("--rerun", {"--step": step})
        return None
    from mapper.export.rerun.target import check_target
    from mapper.runtime.atomic import refuse_existing

    target = check_target(rerun)
    refuse_existing(Path(target), overwrite=overwrite, option="--rerun")

    @contextmanager
    def make_observer(source: "Log", config: "BuildConfig") -> "Iterator[Observer]":
        from mapper.export.rerun.live import live_recording

        is_built = False
        try:
            with live_recording(target, source, config.rerun) as observer:
                yield Stepping(observer) if step else observer
                is_built = True
        except ViewerError as error:
            if not is_built:
                raise
            print(f"mapper: {error}", file=sys.stderr)

    return make_observer


def appended(
    log: Path, onto: Path, overrides: "Sequence[str]", out: Path, *, overwrite: bool, output: Output
) -> "tuple[Run, Sequence[Metric]]":
    """Build a run from a run and a later log of the same place, by the run's configuration."""
    from mapper.config.loading import overridden
    from mapper.evaluators.metrics.evaluate import evaluate
    from mapper.pipeline.append import append
    from mapper.run.folder import open_run
    from mapper.sources import open_source
    from mapper.sources.config import SourceConfig

    first = open_run(onto)
    config = overridden(first.config.model_copy(update={"source": SourceConfig()}), overrides)
    source = open_source(log, config.source)
    progress = output.progress()
    preview = _preview(source, out, progress)
    run = append(source, first, config, out, progress=progress, observer=preview, overwrite=overwrite)
    return run, evaluate(run.trajectory, run.truth).metrics
