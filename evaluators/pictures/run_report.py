"""The report of runs: their key figures, and the page."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapper.core.errors import MapperError
from mapper.core.trajectory import with_rotations
from mapper.evaluators.metrics.agreement import CommonViews, agreement_metrics
from mapper.evaluators.metrics.evaluate import assess
from mapper.evaluators.metrics.loops import loop_metrics_of_run
from mapper.evaluators.metrics.metric import shown
from mapper.export.figures import SIGMAS
from mapper.export.report.data import Figure, Question, chapter_of
from mapper.export.report.page import write_report
from mapper.run.folder import Run
from mapper.runtime.atomic import refuse_existing
from mapper.runtime.regular_files import AnyPath
from mapper.runtime.result_paths import distinct_names, place_of

_DIGITS = 3
_ACCURACY = frozenset(
    {
        "ATE RMSE",
        "RPE translation RMSE",
        "RPE rotation RMSE",
        "relative translation mean",
        "relative rotation mean",
        "loops wrongly accepted",
    }
)
_COVERAGE = frozenset({"path length", "longest gap", "true revisits", "true revisits with a loop"})
"""Quantities of metrics by what they answer."""


def report(runs: Sequence[Run], out: AnyPath | None = None, *, overwrite: bool = False) -> Path:
    """Write one self-contained page about a run, or about several side by side, and return its path.

    Args:
        runs: Finished runs.
        out: HTML file to write; None is ``report.html``, or with a number if that exists.
        overwrite: Replace a file that is there.

    Raises:
        RunError: OUT is there already.
        MapperError: A file of a run cannot be read.
    """
    path = place_of(None if out is None else Path(out), Path("report.html"), overwrite=overwrite)
    refuse_existing(path, overwrite=overwrite)
    names = distinct_names([run.path for run in runs])
    write_report(path, [chapter_of(run, name, _figures(run)) for run, name in zip(runs, names, strict=True)])
    return path


def _figures(run: Run) -> list[Figure]:
    metrics = list(assess(run.trajectory, run.truth, frames_ns=run.frames_ns).metrics)
    if (truth := with_rotations(run.truth)) is not None:
        metrics += loop_metrics_of_run(run, truth)
    figures = [Figure(name, value, "Is it right?") for name, value in _correctness(run)]
    figures.append(Figure("disagreement of views, RMS", _agreement(run), "Is it right?"))
    figures += [Figure(name, value, "Is it complete?") for name, value in _completeness(run)]
    for metric in metrics:
        name, value, unit = shown(metric, digits=_DIGITS)
        figures.append(Figure(name, f"{value} {unit}", _question(metric.quantity)))
    return figures + [Figure(name, value, "How fast was it?") for name, value in _speed(run)]


def _correctness(run: Run) -> list[tuple[str, str]]:
    counts, poses = run.manifest.counts, run.poses
    rows: list[tuple[str, str]] = [("verdict", run.verdict.state)]
    if np.isfinite(poses.position_sigmas_m).any():
        widest_m = SIGMAS * float(np.nanmax(poses.position_sigmas_m))
        rows.append((f"uncertainty of the path, {SIGMAS:g} σ", f"at most {widest_m:.{_DIGITS}g} m"))
    if counts.loop_candidates:
        rows.append(("loops that hold", f"{counts.loops} of {counts.loop_candidates} candidates"))
    return rows


def _agreement(run: Run) -> str:
    """Return how far the poses are from what views of one place show, which needs the log."""
    try:
        views = CommonViews(run.open_log()).disagreements(run.tracked_trajectory)
    except MapperError as error:
        return f"not measured: {error}"
    rms_m, low_m, high_m = (metric.value for metric in agreement_metrics(views)[1:])
    return f"{rms_m:.{_DIGITS}g} m; 95 %: {low_m:.{_DIGITS}g} to {high_m:.{_DIGITS}g} m"


def _completeness(run: Run) -> list[tuple[str, str]]:
    counts = run.manifest.counts
    incomplete = (("doubtful", counts.doubtful), ("lost", counts.lost), ("skipped", counts.skipped))
    return [
        ("frames tracked", f"{counts.tracked} of {counts.listed}"),
        *((f"frames {what}", str(n)) for what, n in incomplete if n),
        ("graph", f"{counts.nodes} nodes, {counts.factors} factors"),
        ("octree", f"{counts.voxels_text} of {run.config.octree.resolution_m:g} m"),
        ("cloud", f"{counts.cloud_points:,} points"),
    ]


def _speed(run: Run) -> list[tuple[str, str]]:
    timing = run.manifest.timing
    return [
        ("build", f"{timing.total_s:.{_DIGITS}g} s for {timing.log_s:.{_DIGITS}g} s of log"),
        ("× real time", f"{timing.real_time_factor:.{_DIGITS}g}"),
        ("frames per second", f"{timing.frames_per_s:.{_DIGITS}g}"),
        *((f"to {stage}", f"{seconds:.{_DIGITS}g} s") for stage, seconds in timing.stage_s.items()),
        ("peak memory", f"{timing.peak_memory_mb:.{_DIGITS}g} MB"),
    ]


def _question(quantity: str) -> Question:
    if quantity in _ACCURACY:
        return "Is it right?"
    return "Is it complete?" if quantity in _COVERAGE else ""
