"""``mapper inspect``: what is in a log, and what mapper build would do with it."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.options import Overrides, settings_of
from mapper.core.errors import DataError

if TYPE_CHECKING:
    from mapper.sources.image_quality import ImageQuality
    from mapper.sources.inspection import Inspection, LogFacts, Timing, TopicFacts


def inspect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recorded log: a folder, .mbag, .mcap or .bag.")],
    time_offset: Annotated[
        bool,
        typer.Option("--time-offset", help="Track the log; show how late depth, IMU, wheels and truth are."),
    ] = False,
    set_: Overrides = None,
    *,
    output: Output,
) -> Answer:
    """Show what is in a log: topics, rates, gaps, calibration, truth, and what mapper build would do.

    Exit status 1 means that nothing can be mapped.

    Example: mapper inspect drive.mcap
    """
    import dataclasses

    from mapper.api.logs import inspect as inspect_log
    from mapper.config.loading import load_config
    from mapper.sources.frame_selection import too_few_text

    settings = settings_of({}, set_)
    found = inspect_log(log, settings=settings, time_offset=time_offset, progress=output.progress())
    problem, plan = found.problem, ""
    if found.log is not None:
        config = load_config(settings, sensor=found.log.sensor)
        if problem is None and (frames := found.log.usable) < config.min_tracked_frames:
            problem = too_few_text(frames, config.min_tracked_frames, found.log.notes)
        plan = (
            f"{found.log.sensor} frames, odometry {config.odometry.kind}, loops {config.loops.kind}, "
            f"octree of {config.octree.resolution_m:g} m"
        )
    if problem is not None:
        plan = f"nothing: {problem}"
    answer = {**dataclasses.asdict(found), "problem": problem, "build": plan}
    error = None if problem is None else DataError(f"nothing can be mapped: {problem}")
    return Answer(answer, "\n".join(_lines(found, plan)), error=error)


def _lines(found: "Inspection", plan: str) -> Iterator[str]:
    rows = [("log", str(found.path))]
    if found.log is not None:
        rows += _log_rows(found.log)
    rows += [(f"time, {offset.sensor}", offset.text) for offset in found.time_offsets or ()]
    if found.time_offsets is not None and not found.time_offsets:
        rows.append(
            ("time", "nothing beside the frames to compare: no depth, gyroscope, wheels, truth or poses")
        )
    rows.append(("mapper build", plan))
    width = max(len(name) for name, _ in rows)
    yield from (f"{name:<{width}}  {text}" for name, text in rows)
    if found.topics:
        yield ""
        yield from _table(found.topics)


def _log_rows(log: "LogFacts") -> list[tuple[str, str]]:
    rows = [
        ("format", f"{log.kind}, called {log.name}"),
        ("frames", f"{log.frames.count}: {_timing_text(log.frames)}"),
        ("content", log.content),
    ]
    if log.point_times is not None:
        rows.append(("point times", log.point_times))
    if log.images is not None:
        rows += _image_rows(log.images)
    if log.calibration is not None:
        rows.append(("camera", log.calibration))
    rows.append(("truth", log.truth or "none"))
    if log.device_poses is not None:
        rows.append(("device poses", f"{log.device_poses}; --set odometry.kind=given maps by them"))
    if log.wheels is not None:
        rows.append(
            (
                "wheels",
                f"{log.wheels.count} poses over {log.wheels_path_m:.1f} m: {_timing_text(log.wheels)}",
            )
        )
    if log.readings:
        rows.append(("accelerations", f"{log.readings} readings"))
    if log.gyroscope is not None:
        rows.append(("gyroscope", f"{log.gyroscope.count} readings: {_timing_text(log.gyroscope)}"))
    if log.gnss is not None:
        sigma = "not stated" if log.gnss_sigma_m is None else f"{log.gnss_sigma_m:.2g} m (median)"
        rows.append(
            ("gnss", f"{log.gnss.count} fixes ({log.gnss_status}), σ {sigma}: {_timing_text(log.gnss)}")
        )
    if log.vehicle is not None:
        numbers = ",".join(f"{v:g}" for v in log.vehicle)
        left_out = f"build leaves out returns that stay in place near the sensor: source.body.box=[{numbers}]"
        rows.append(("own vehicle", f"{left_out}; source.body.find_box=false keeps them"))
    rows += [("note", note) for note in log.notes]
    rows += [("warning", warning) for warning in log.warnings]
    return rows + [("next time", advice) for advice in (log.images.advice if log.images else ())]


def _image_rows(images: "ImageQuality") -> Iterator[tuple[str, str]]:
    edges = "no edges" if images.edges_px is None else f"edges {images.edges_px:.1f} px wide (median)"
    yield (
        "images",
        f"{edges}, {images.blurred or 'none'} of {images.looked_at} blurred; {images.saturated:.0%} of the "
        f"pixels saturated, 5% brighter than level {images.brightest:.0f} of 255",
    )
    if images.overlap is not None:
        yield (
            "overlap",
            f"neighbouring images have {images.overlap:.0%} of the view in common (median), those from frame "
            f"{images.least_overlap_frame} {images.least_overlap:.0%}, the least",
        )


def _timing_text(timing: "Timing") -> str:
    count = "1 gap" if timing.gaps == 1 else f"{timing.gaps} gaps"
    gaps = f"{count}, the longest {timing.longest_gap_s:.2f} s" if timing.gaps else "no gaps"
    return f"{timing.duration_s:.1f} s at {timing.rate_hz:.1f} Hz, {gaps}"


def _table(topics: "Sequence[TopicFacts]") -> Iterator[str]:
    rows = [("topic", "type", "messages", "Hz", "gaps", "longest (s)")]
    for topic in topics:
        timing = topic.timing
        numbers = (
            f"{timing.count}",
            f"{timing.rate_hz:.1f}",
            f"{timing.gaps}",
            f"{timing.longest_gap_s:.2f}",
        )
        rows.append((topic.name, topic.type, *numbers))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        name, type_, numbers = row[0], row[1], row[2:]
        words = [f"{name:<{widths[0]}}", f"{type_:<{widths[1]}}"]
        words += [f"{number:>{width}}" for number, width in zip(numbers, widths[2:], strict=True)]
        yield "  ".join(words)
