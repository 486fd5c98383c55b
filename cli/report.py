"""``mapper report``: runs as one HTML page."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.answer import Answer, Output, made
from cli.options import RunFolders

if TYPE_CHECKING:
    from mapper.export.report.data import Figure
    from mapper.run.folder import Run


_DIGITS = 3


def report(
    runs: RunFolders,
    out: Annotated[Path, typer.Option(help="HTML file to write.")] = Path("report.html"),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT.")] = False,
    *,
    output: Output,
) -> Answer:
    """Write one self-contained page about a run, or about several side by side; it opens offline.

    Example: mapper report runs/xyz runs/xyz-isvd --out report.html
    """
    from mapper.core.errors import RunError
    from mapper.export.report.data import chapter_of
    from mapper.export.report.page import write_report
    from mapper.run.folder import open_run

    if out.exists() and not overwrite:
        raise RunError(f"{out}: exists already; choose another --out, or pass --overwrite to replace it")
    loaded = [open_run(run) for run in runs]
    names = distinct_names(runs)
    with output.waiting("report"):
        chapters = [chapter_of(run, name, _figures(run)) for run, name in zip(loaded, names, strict=True)]
        write_report(out, chapters)
    return made(out)


def distinct_names(runs: Sequence[Path]) -> list[str]:
    """Return the folders' names, or their paths as given where names are not unique."""
    short = [run.resolve().name for run in runs]
    seen = Counter(short)
    return [str(run) if seen[name] > 1 else name for run, name in zip(runs, short, strict=True)]


def _figures(run: "Run") -> "list[Figure]":
    import numpy as np

    from evaluators.metrics.evaluate import assess
    from evaluators.metrics.loops import loop_metrics
    from evaluators.metrics.metric import shown
    from mapper.export.report.data import Figure

    counts, truth = run.manifest.counts, run.truth
    frames_ns = np.array([record.stamp_ns for record in run.records], dtype=np.int64)
    metrics = list(assess(run.trajectory, truth, frames_ns=frames_ns).metrics)
    if truth is not None:
        metrics += loop_metrics(run.loops, run.keyframes.stamps_ns, truth)
    return [
        Figure("log", run.manifest.input.title),
        Figure("verdict", run.verdict.state),
        Figure("frames tracked", f"{counts.tracked} of {counts.listed}"),
        Figure("frames doubtful", str(counts.doubtful)),
        Figure("frames lost", str(counts.lost)),
        Figure("frames skipped", str(counts.skipped)),
        Figure("nodes", str(counts.nodes)),
        Figure("factors", str(counts.factors)),
        Figure("loops that hold", f"{counts.loops} of {counts.loop_candidates}"),
        Figure("octree leaves", f"{counts.leaves} of {run.config.octree.resolution_m:g} m"),
        *(
            Figure(name, f"{value} {unit}")
            for name, value, unit in (shown(metric, digits=_DIGITS) for metric in metrics)
        ),
    ]
