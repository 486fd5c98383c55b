"""The table at the end of a build."""

from collections import Counter
from collections.abc import Sequence
from math import degrees
from pathlib import Path
from statistics import median
from textwrap import wrap

from evaluators.metrics.metric import Metric
from mapper.loops.closure import LoopClosure
from mapper.run.folder import Run
from mapper.run.frame_outcomes import FrameRecord

_LINE_WIDTH = 110
_SHOWN_NOTES = frozenset({"gap", "lost", "doubtful", "skipped", "levelling"})
_SHOWN = ("ATE RMSE", "RPE translation RMSE", "RPE rotation RMSE", "path length", "start-to-end offset")


def summary_text(run: Run, metrics: Sequence[Metric]) -> str:
    """Return what a run amounts to, a line per fact."""
    counts, timing = run.manifest.counts, run.manifest.timing
    rows = [
        ("frames", counts.frames_text),
        ("keyframes", f"{counts.nodes}, with {counts.factors} factors"),
        ("loops", _loops_text(run.loops)),
        *((metric.name, _value_text(metric)) for metric in metrics if metric.name.startswith(_SHOWN)),
        *_left_open(run.records),
        ("octree", f"{counts.leaves} leaves of {run.config.octree.resolution_m:g} m"),
    ]
    if run.manifest.input.appended:
        rows.insert(0, ("logs", run.manifest.input.title))
    if run.manifest.levelling is not None:
        rows.append(("levelled by", f"{run.manifest.levelling.method}: {run.manifest.levelling.detail}"))
    if run.manifest.edits:
        rows.append(("edited by hand", f"{len(run.manifest.edits)} regions; mapper edit lists them"))
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in timing.stage_s.items())
    rows += [
        ("seconds", f"{timing.total_s:.1f} ({stages})"),
        ("speed", f"{timing.frames_per_s:.1f} frames/s, {timing.real_time_factor:.2f} × real time"),
        ("peak memory", f"{timing.peak_memory_mb:.0f} MB"),
        ("files", _files_text(run.files())),
        ("in", str(run.path)),
        *_verdict_rows(run),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(_row(name, text, indent=width + 2) for name, text in rows)


def verdict_text(run: Run) -> str:
    """Return the verdict on a run, a line per sentence."""
    rows = _verdict_rows(run)
    return "\n".join(_row(name, text, indent=len("verdict") + 2) for name, text in rows)


def _verdict_rows(run: Run) -> list[tuple[str, str]]:
    """Return the verdict, and below it why the run is not trusted and what to try."""
    verdict = run.verdict
    notes = [
        warning.text
        for warning in run.manifest.warnings
        if warning.weight == "note" and warning.kind in _SHOWN_NOTES
    ]
    return [("verdict", verdict.state), *(("", text) for text in (*verdict.sentences, *notes))]


def _loops_text(loops: Sequence[LoopClosure]) -> str:
    """Return how many loops hold, how far they moved the path, and why the other candidates do not."""
    held = [loop for loop in loops if loop.verdict == "accepted"]
    refused = Counter(loop.reason.split(":")[0] for loop in loops if loop.verdict == "rejected")
    text = f"{len(held)} of {len(loops)} candidates hold"
    if refused:
        text += f"; refused by {', '.join(f'{why} {count}' for why, count in refused.most_common())}"
    moved = [
        (loop.before.translation_m, loop.after.translation_m) for loop in held if loop.before and loop.after
    ]
    if moved:
        before_m, after_m = (median(column) for column in zip(*moved, strict=True))
        text += f"; median residual {before_m:.3f} m before the solve, {after_m:.3f} m after"
    return text


def _left_open(records: Sequence[FrameRecord]) -> list[tuple[str, str]]:
    """Return a row on the motions that no surface showed, if there were any."""
    unseen = Counter(record.diagnostics.unobservable for record in records if record.diagnostics.unobservable)
    if not unseen:
        return []
    text, _ = unseen.most_common(1)[0]
    return [("left open", f"in {unseen.total()} frames, mostly {text}: no surface showed it")]


def _row(name: str, text: str, *, indent: int) -> str:
    lines = wrap(text, _LINE_WIDTH - indent, break_long_words=False, break_on_hyphens=False)
    return "\n".join([f"{name:<{indent}}{lines[0]}", *(" " * indent + line for line in lines[1:])])


def _value_text(metric: Metric) -> str:
    if metric.unit == "rad":
        return f"{degrees(metric.value):.3f}°"
    return f"{metric.value:.4f} {metric.unit}"


def _files_text(paths: Sequence[Path]) -> str:
    size_mb = sum(path.stat().st_size for path in paths) / 1e6
    return f"{', '.join(path.name for path in paths)} ({size_mb:.1f} MB)"
