"""Summary of a run: the lines at the end of a build, all rows of ``--verbose``, and the same as JSON."""

from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from math import degrees
from pathlib import Path
from shlex import quote
from statistics import median
from typing import Any

from mapper.cli.answer import Answer, rows_text
from mapper.core.errors import DataError
from mapper.evaluators.metrics.evaluate import (
    ATE_RMSE,
    ATE_WITH_LEVER_ARM,
    ATE_WITHOUT_OFFSET,
    CLOCK_OFFSET,
    LEVER_ARM,
    PATH_LENGTH,
    RPE_RMSE_M,
    RPE_RMSE_RAD,
    START_TO_END,
    evaluate,
)
from mapper.evaluators.metrics.metric import Metric, records_of
from mapper.loops.closure import LoopClosure, accepted_loops, rejections
from mapper.run.folder import Run
from mapper.run.frame_records import FrameRecord
from mapper.run.manifest import Counts, Timing

_SHOWN_NOTES = frozenset({"gap", "lost", "doubtful", "skipped", "levelling", "shutter"})
_SHOWN = frozenset({ATE_RMSE, RPE_RMSE_M, RPE_RMSE_RAD, PATH_LENGTH, START_TO_END})


def summary_of(run: Run) -> Answer:
    """Return a run as the answer of the verb that made it, its path judged by the truth if there is any."""
    unknown = ""
    try:
        metrics = evaluate(run.trajectory, run.truth).metrics
    except DataError as error:  # as where no pose of the truth is near a frame
        metrics = evaluate(run.trajectory, None).metrics
        unknown = f"not known: {error}"
    return Answer(
        run_document(run, metrics), short_text(run, metrics, unknown), summary_text(run, metrics, unknown)
    )


def run_document(run: Run, metrics: Sequence[Metric]) -> dict[str, Any]:
    """Return a run's numbers for other programs."""
    counts, timing, verdict = run.manifest.counts, run.manifest.timing, run.verdict
    return {
        "run": run.path,
        "logs": [log.path for log in (run.manifest.input, *run.manifest.input.appended)],
        "frames": frame_counts(counts),
        "keyframes": counts.nodes,
        "factors": counts.factors,
        "loops": _loop_counts(run.loops),
        "metrics": records_of(metrics),
        "octree": {
            "leaves": counts.leaves,
            "occupied": counts.occupied,
            "resolution_m": run.config.octree.resolution_m,
        },
        "cloud_points": counts.cloud_points,
        "resumed": timing.resumed,
        "stage_s": timing.stage_s,
        "total_s": timing.total_s,
        "frames_per_s": timing.frames_per_s,
        "real_time_factor": timing.real_time_factor,
        "peak_memory_mb": timing.peak_memory_mb,
        "files": {path.name: path.stat().st_size for path in run.files()},
        "verdict": verdict,
    }


def frame_counts(counts: Counts) -> dict[str, int]:
    """Return how many frames had which outcome."""
    return {key: getattr(counts, key) for key in ("listed", "read", "tracked", "doubtful", "lost", "skipped")}


def short_text(run: Run, metrics: Sequence[Metric], unknown: str = "") -> str:
    """Return the main figures in eight lines, why the accuracy is unknown, and why a run is not trusted."""
    counts, timing, verdict = run.manifest.counts, run.manifest.timing, run.verdict
    logs = f", of {run.manifest.input.title}" if run.manifest.input.appended else ""
    lengths_m = [metric.value for metric in metrics if metric.quantity == PATH_LENGTH]
    in_browser = "" if find_spec("rerun") else " --html"
    path = f", along a path of {lengths_m[0]:.2f} m" if lengths_m else ""
    speed = f"{timing.frames_per_s:.1f} frames/s, {timing.real_time_factor:.2f} × real time"
    rows = [
        ("frames", f"{counts.frames_text}{logs}"),
        ("loops", f"{counts.loops} of {counts.loop_candidates} candidates hold"),
        ("accuracy", _accuracy_text(metrics) or unknown),
        ("map", f"{counts.voxels_text} of {run.config.octree.resolution_m:g} m{path}"),
        ("speed", f"{speed}; {timing.total_s:.1f} s and {timing.peak_memory_mb:.0f} MB in all"),
        ("resumed", _resumed_text(timing)),
        ("run", f"{run.path} ({len(run.files())} files, {_size_mb(run.files()):.1f} MB)"),
        ("verdict", verdict.state),
        *(("", sentence) for sentence in verdict.sentences),
        ("next", f"mapper view {quote(str(run.path))}{in_browser}"),
    ]
    return rows_text([(name, text) for name, text in rows if text])


def _resumed_text(timing: Timing) -> str:
    return "; ".join(resumption.text for resumption in timing.resumed)


def summary_text(run: Run, metrics: Sequence[Metric], unknown: str = "") -> str:
    """Return the summary of a run, a line per fact, and why its accuracy is unknown."""
    counts, timing = run.manifest.counts, run.manifest.timing
    rows = [
        ("frames", counts.frames_text),
        ("keyframes", f"{counts.nodes}, with {counts.factors} factors"),
        ("loops", _loops_text(run.loops)),
        *((metric.name, _value_text(metric)) for metric in metrics if metric.quantity in _SHOWN),
        *([("accuracy", unknown)] if unknown else []),
        *_left_open(run.records),
        ("octree", f"{counts.voxels_text} of {run.config.octree.resolution_m:g} m"),
    ]
    if run.manifest.input.appended:
        rows.insert(0, ("logs", run.manifest.input.title))
    if run.manifest.levelling is not None:
        rows.append(("levelled by", f"{run.manifest.levelling.method}: {run.manifest.levelling.detail}"))
    if run.manifest.edits:
        rows.append(("edited by hand", f"{len(run.manifest.edits)} regions; mapper edit lists them"))
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in timing.stage_s.items())
    if timing.resumed:
        rows.append(("resumed", _resumed_text(timing)))
    rows += [
        ("seconds", f"{timing.total_s:.1f} ({stages})"),
        ("speed", f"{timing.frames_per_s:.1f} frames/s, {timing.real_time_factor:.2f} × real time"),
        ("peak memory", f"{timing.peak_memory_mb:.0f} MB"),
        ("files", f"{', '.join(path.name for path in run.files())} ({_size_mb(run.files()):.1f} MB)"),
        ("in", str(run.path)),
        *_verdict_rows(run),
    ]
    return rows_text(rows)


def verdict_text(run: Run) -> str:
    """Return the verdict on a run, a line per sentence."""
    return rows_text(_verdict_rows(run))


def _verdict_rows(run: Run) -> list[tuple[str, str]]:
    verdict = run.verdict
    notes = [
        warning.text
        for warning in run.manifest.warnings
        if warning.weight == "note" and warning.kind in _SHOWN_NOTES
    ]
    return [("verdict", verdict.state), *(("", text) for text in (*verdict.sentences, *notes))]


def _accuracy_text(metrics: Sequence[Metric]) -> str:
    """Return the errors by the truth; empty without one."""
    found = {metric.quantity: metric for metric in metrics}
    if ATE_RMSE not in found:
        return ""
    text = f"{found[ATE_RMSE].name} {_value_text(found[ATE_RMSE])}"
    if RPE_RMSE_M in found and RPE_RMSE_RAD in found:
        steps = (_value_text(found[quantity]) for quantity in (RPE_RMSE_M, RPE_RMSE_RAD))
        text += f"; from frame to frame {' and '.join(steps)}"
    if LEVER_ARM in found:
        lever_m, rmse_m = (found[quantity].value for quantity in (LEVER_ARM, ATE_WITH_LEVER_ARM))
        text += f"; of positions alone, which fit a point {lever_m:.2f} m beside to {rmse_m:.4f} m"
    if CLOCK_OFFSET in found:
        late_s, rmse_m = (found[quantity].value for quantity in (CLOCK_OFFSET, ATE_WITHOUT_OFFSET))
        how = "late" if late_s > 0.0 else "early"
        text += f"; the truth's stamps seem {abs(late_s):.3f} s {how}, without which ATE is {rmse_m:.4f} m"
    return text


def _loop_counts(loops: Sequence[LoopClosure]) -> Mapping[str, Any]:
    """Return how many loops hold, how far they moved the path, and why the other candidates do not."""
    held = accepted_loops(loops)
    moved = [
        (loop.before.translation_m, loop.after.translation_m) for loop in held if loop.before and loop.after
    ]
    before_m, after_m = (median(column) for column in zip(*moved, strict=True)) if moved else (None, None)
    return {
        "candidates": len(loops),
        "accepted": len(held),
        "refused": rejections(loops),
        "median_residual_before_m": before_m,
        "median_residual_after_m": after_m,
    }


def _loops_text(loops: Sequence[LoopClosure]) -> str:
    counts = _loop_counts(loops)
    text = f"{counts['accepted']} of {counts['candidates']} candidates hold"
    if counts["refused"]:
        text += f"; refused by {', '.join(f'{why} {count}' for why, count in counts['refused'].items())}"
    if counts["median_residual_before_m"] is not None:
        text += (
            f"; median residual {counts['median_residual_before_m']:.3f} m before the solve, "
            f"{counts['median_residual_after_m']:.3f} m after"
        )
    return text


def _left_open(records: Sequence[FrameRecord]) -> list[tuple[str, str]]:
    unseen = Counter(record.diagnostics.unobservable for record in records if record.diagnostics.unobservable)
    if not unseen:
        return []
    text, _ = unseen.most_common(1)[0]
    return [("left open", f"in {unseen.total()} frames, mostly {text}: no surface showed it")]


def _value_text(metric: Metric) -> str:
    if metric.unit == "rad":
        return f"{degrees(metric.value):.3f}°"
    return f"{metric.value:.4f} {metric.unit}"


def _size_mb(paths: Sequence[Path]) -> float:
    return sum(path.stat().st_size for path in paths) / 1e6
