"""``mapper build``, ``fuse`` and ``demo``: a run of a log; its maps again; a synthetic log and its run."""

import json
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output, rows_text, untrusted
from mapper.cli.completion import run_folders
from mapper.cli.options import (
    ConfigFile,
    First,
    Last,
    MovedLogs,
    Overrides,
    Overwrite,
    RequireTruth,
    RunFolder,
    Stride,
    refuse_with,
    refuse_without,
    selection,
    settings_of,
)
from mapper.core.errors import ConfigError
from mapper.run.observers import NULL_OBSERVER, Observers

if TYPE_CHECKING:
    from mapper.run.observers import Step
    from mapper.runtime.profiler import Profiler
    from mapper.simulation.config import SynthConfig


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
    profile: Annotated[
        bool,
        typer.Option(
            "--profile", help="Print what a frame costs in each stage; write samples for speedscope.app."
        ),
    ] = False,
    *,
    output: Output,
) -> Answer:
    """Turn a recorded log into a pose graph, an octree map, a 2D slice and an MCAP log.

    Example: mapper build rgbd_dataset_freiburg1_xyz --set octree.resolution_m=0.1
    """
    from mapper.api.build import build as build_run

    if rerun is None:
        refuse_without("--rerun", {"--step": step})
    if onto is not None:
        refuse_with("--onto", {"--config": config}, remedy="give single settings by --set")
        refuse_with("--onto", {"--rerun": rerun}, remedy="look at the new run with mapper view")
        refuse_with("--onto", {"--fresh": fresh, "--profile": profile})
    profiler = None
    if profile:
        from mapper.runtime.profiler import Profiler

        profiler = Profiler(output.progress(prompts=step))
    with profiler or nullcontext():
        run = build_run(
            log,
            out=out,
            config=config,
            settings=settings_of(selection(first, last, stride, require_truth), set_),
            onto=onto,
            rerun=rerun,
            progress=profiler or output.progress(prompts=step),
            observer=Stepping() if step else NULL_OBSERVER,
            overwrite=overwrite,
            fresh=fresh,
        )
    from mapper.cli.summary import summary_of  # a build begins without what its end needs

    error = untrusted(run.path, run.verdict) if strict else None
    answer = replace(summary_of(run), error=error)
    return answer if profiler is None else _with_profile(answer, profiler, run.path)


def _with_profile(answer: Answer, profiler: "Profiler", run: Path) -> Answer:
    """Write the samples beside a run, and return its answer with the time of each stage."""
    file = run.with_name(f"{run.name}.speedscope.json")
    profiler.write(file, name=run.name)
    stages = profiler.stages()
    rows = [
        f"{name}: {one['items']} items in {one['total_s']:.1f} s, {one['median_ms']:.1f} ms each (median), "
        f"95 % within {one['p95_ms']:.1f} ms"
        for name, one in stages.items()
    ]
    lines = rows_text([("profile", rows[0]), *(("", row) for row in [*rows[1:], f"{file}"])])
    return replace(
        answer,
        document={**answer.document, "profile": {"stages": stages, "file": file}},
        text=f"{answer.text}\n{lines}",
        details=f"{answer.details}\n{lines}",
    )


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
    from mapper.run.folder import moved_log, open_run
    from mapper.sources.trajectory_files import read_tum

    built = open_run(run)
    if log:
        built = moved_log(built, *log)
    poses = None if trajectory is None else read_tum(trajectory)
    return summary_of(
        built.fuse(settings=settings_of({}, set_), trajectory=poses, progress=output.progress())
    )


DEMO_LOG = {"path": "loop", "width_px": 320, "height_px": 240}


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the log and the run.")] = Path("demo"),
    seconds: Annotated[float | None, typer.Option(help="Length of the log; omit for one round.")] = None,
    set_: Overrides = None,
    *,
    output: Output,
) -> Answer:
    """Make a synthetic log of a walk through a flat, build a map from it, and print where its pictures are.

    Example: mapper demo --out /tmp/demo --seconds 20
    """
    from mapper.api.build import build as build_run
    from mapper.cli.summary import summary_of
    from mapper.config.loading import load_config, overridden
    from mapper.run import files
    from mapper.simulation import write_tum_log
    from mapper.simulation.config import SynthConfig

    settings = settings_of({}, set_)
    load_config(settings)  # what is wrong with it is better known before the log is made
    log = out / "log"
    scene = overridden(SynthConfig(), settings=settings_of({**DEMO_LOG, "duration_s": seconds}))
    if not _is_made(log, scene):
        with output.progress().stage("render") as report:
            write_tum_log(log, scene, on_progress=report)
    run = build_run(log, out=out / "run", settings=settings, progress=output.progress(), overwrite=True)
    pictures = [run.path / name for name in (files.SUMMARY, files.CLOUD_VIEWS, f"{files.SLICE}.png")]
    summary, below = summary_of(run), "\n".join(map(str, pictures))
    return Answer(
        {**summary.document, "pictures": pictures},
        f"{summary.text}\n{below}",
        f"{summary.details}\n{below}",
    )


def _is_made(log: Path, scene: "SynthConfig") -> bool:
    """Return whether an earlier demo left this very log, which takes longer to make than to map."""
    made_from = log / "scene.json"
    return made_from.is_file() and json.loads(made_from.read_text())["config"] == scene.model_dump(
        mode="json"
    )


class Stepping(Observers):
    """Waits for Enter after every frame (Somlyai, PhD thesis, §3.6)."""

    def __init__(self) -> None:
        """Refuse to wait for keys where standard input is no terminal.

        Raises:
            ConfigError: Standard input is no terminal.
        """
        if not sys.stdin.isatty():
            raise ConfigError("--step: waits for Enter after each frame, but standard input is no terminal")
        self._frames = 0
        self._waits = True
        _say("stepping: Enter for the next frame, c and Enter to run on")

    def on_frame(self, step: "Step", /) -> None:
        """Print how the frame went, and wait."""
        self._frames += 1
        if not self._waits:
            return
        how = step.track.diagnostics
        place = "lost" if step.track.node is None else f"node {step.track.node}, {how.inliers} inliers"
        kept = ", a keyframe" if step.track.is_keyframe else ""
        if step.track.doubts:
            kept += f", doubtful: {', '.join(doubt.text for doubt in step.track.doubts)}"
        _say(f"frame {self._frames} at {step.track.stamp_ns}: {how.method}, {place}{kept} ", end="")
        sys.stderr.flush()
        answer = sys.stdin.readline()
        self._waits = answer.strip() != "c" and bool(answer)


def _say(text: str, *, end: str = "\n") -> None:
    print(text, end=end, file=sys.stderr)
