"""Evaluation of one trajectory: all its metrics, with truth or without, and where its poses come from."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError, SourceError
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory, with_rotations, without_idle_rotations
from mapper.evaluators.metrics.clock_offset import clock_offset
from mapper.evaluators.metrics.coverage import frame_coverage, time_coverage
from mapper.evaluators.metrics.metric import Metric, shown, text_table
from mapper.evaluators.metrics.segments import LengthErrors, lengths_for, segment_errors, segment_metrics
from mapper.evaluators.metrics.trajectory_errors import (
    AlignmentKind,
    Matched,
    Similarity,
    align,
    associate,
    ate,
    lever_arm,
    rpe,
    start_end_offset,
)
from mapper.run.folder import Run, open_run
from mapper.runtime.regular_files import AnyPath
from mapper.sources.text import parse_stamp, rows
from mapper.sources.trajectory_files import is_mulran, read_kitti, read_mulran, read_tum

Estimate = Run | Trajectory | AnyPath
"""A run or its folder, a trajectory, or a file of TUM, EuRoC, MulRan or KITTI text."""


ALIGNED = {
    "none": "not aligned",
    "yaw": "yaw-aligned",
    "se3": "SE(3)-aligned",
    "sim3": "Sim(3)-aligned",
}
ATE_RMSE = "ATE RMSE"
RPE_RMSE_M, RPE_RMSE_RAD = "RPE translation RMSE", "RPE rotation RMSE"
PATH_LENGTH, START_TO_END = "path length", "start-to-end offset"
CLOCK_OFFSET = "clock offset of the truth"
ATE_WITHOUT_OFFSET = f"{CLOCK_OFFSET}: {ATE_RMSE} without it"
LEVER_ARM = "lever arm of the true positions"
ATE_WITH_LEVER_ARM = f"{LEVER_ARM}: {ATE_RMSE} with it"
"""Quantities of metrics that a summary of a run shows."""

_CLOCK_NS = 1_000_000


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Assessment:
    """Evaluation of a trajectory.

    Attributes:
        metrics: Every number, the errors first.
        matched: The poses that have a true one, aligned with it; None without truth.
        lengths: Errors over the segments of each length; empty without truth.
    """

    metrics: tuple[Metric, ...]
    matched: Matched | None = None
    lengths: tuple[LengthErrors, ...] = ()

    def __iter__(self) -> Iterator[Metric]:
        return iter(self.metrics)

    def __len__(self) -> int:
        return len(self.metrics)

    def __getitem__(self, name: str) -> float:
        """Return the value of a metric, in the unit that it has there, by its name or the beginning of it.

        Raises:
            KeyError: No metric, or several, begin so.
        """
        found = [metric for metric in self.metrics if metric.name == name] or [
            metric for metric in self.metrics if metric.name.startswith(name)
        ]
        if len(found) != 1:
            names = ", ".join(metric.name for metric in found or self.metrics)
            raise KeyError(f"{name!r}: want one of {names}")
        return found[0].value

    @property
    def ate_m(self) -> float | None:
        """Absolute trajectory error, RMSE, metres, after the alignment; None without truth."""
        return next((m.value for m in self.metrics if m.quantity == ATE_RMSE), None)

    def __repr__(self) -> str:
        return text_table(self.metrics)

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in shown(metric))}</tr>"
            for metric in self.metrics
        )
        return f"<table>{rows}</table>"


def evaluate(
    estimate: Estimate,
    truth: Trajectory | AnyPath | None = None,
    *,
    alignment: AlignmentKind = "se3",
    times: AnyPath | None = None,
    max_gap_s: float = 0.02,
    lengths_m: Sequence[float] | None = None,
) -> Assessment:
    """Evaluate a path: its length, coverage, and with truth ATE, RPE and relative errors; a run's loops too.

    Args:
        estimate: A run or its folder, a trajectory, or a file of TUM or KITTI text.
        truth: True poses of the body: the same but a run; None takes a run's own, if its log has any.
        alignment: Alignment of the estimate with the truth: "none", "yaw" (for worlds with z up), "se3"
            or "sim3".
        times: File of seconds, one a line, for poses in KITTI text; else these pair by line.
        max_gap_s: Largest time between an estimated pose and its true one.
        lengths_m: Lengths of the segments of the relative errors; None chooses them by the length of the true
            path.

    Returns:
        The metrics: ``found["ATE RMSE"]`` is one of them, ``print(found)`` a table of all; distances are
        metres, angles radians, and degrees in tables.

    Raises:
        RunError: A folder is no finished run.
        SourceError: A file cannot be read.
        DataError: A file is malformed, or no stamps match, or too few.

    Example:
        >>> found = mapper.evaluate(run)
        >>> found.ate_m < 0.05, found["ATE RMSE"] == found.ate_m
        (True, True)
    """
    run, trajectory, known = estimate_and_truth(estimate, truth, times)
    frames_ns = None if run is None else run.frames_ns
    names = [
        str(one) if isinstance(one, str | os.PathLike) else default
        for one, default in ((estimate, "the estimate"), (truth, "the truth"))
    ]
    found = assess(
        trajectory,
        known,
        alignment=alignment,
        frames_ns=frames_ns,
        lengths_m=lengths_m,
        max_gap_s=max_gap_s,
        names=(names[0], names[1]),
    )
    return found if run is None else replace(found, metrics=(*found.metrics, *run_metrics(run, known)))


def run_metrics(run: Run, truth: Trajectory | None) -> list[Metric]:
    """Return what a run's loops and covariances show, and with truth how many loops are right."""
    from mapper.evaluators.metrics.consistency import drift_metrics  # need GTSAM, which few verbs do
    from mapper.evaluators.metrics.loops import agreement_of_loops, loop_metrics_of_run

    posed = with_rotations(truth)
    right = [] if posed is None else loop_metrics_of_run(run, posed)
    return [*right, *drift_metrics(run.poses), *agreement_of_loops(run.graph)]


def assess(
    estimate: Trajectory,
    truth: Trajectory | None,
    *,
    alignment: AlignmentKind = "se3",
    frames_ns: Stamps | None = None,
    lengths_m: Sequence[float] | None = None,
    max_gap_s: float = 0.02,
    names: tuple[str, str] = ("the estimate", "the truth"),
) -> Assessment:
    """Return path length, start-to-end offset and coverage, and with truth ATE, RPE and relative errors.

    The names state the alignment. RPE compares consecutive matched poses. Of true positions without rotations
    there is ATE alone: of the body's origin, and of the point on the body that fits them best.

    Args:
        estimate: The trajectory.
        truth: True poses of the body, or None if they are not known.
        alignment: Alignment of the estimate with the truth.
        frames_ns: Stamps of all frames of the log, of which the estimate should have poses; None takes the
            time that the truth covers instead.
        lengths_m: Lengths of the segments of the relative errors; None chooses them by the length of the true
            path.
        max_gap_s: Largest time between an estimated pose and its true one.
        names: Names of the two in an error, such as their file names.

    Raises:
        DataError: The estimate is empty, no stamps match, too few do, or a length is not > 0.
    """
    offset_m, offset_rad = start_end_offset(estimate)
    own = [
        *_coverage(estimate, truth, frames_ns),
        Metric(PATH_LENGTH, estimate.path_length_m, "m"),
        Metric(START_TO_END, offset_m, "m"),
        Metric("start-to-end rotation", offset_rad, "rad"),
    ]
    if truth is None:
        return Assessment(tuple(own))
    matched = associate(estimate, truth, max_gap_s=max_gap_s, names=names)
    similarity = align(matched, alignment)
    aligned = similarity.moved(matched)
    if with_rotations(truth) is None or with_rotations(estimate) is None:
        errors = [*_position_errors(aligned, alignment), *_lever_metrics(matched, alignment)]
        return Assessment((*errors, *_clock_metrics(estimate, truth, alignment), *own), aligned)
    lengths = segment_errors(aligned, lengths_for(truth.path_length_m) if lengths_m is None else lengths_m)
    metrics = [
        *_against_truth(aligned, alignment),
        *_alignment_metrics(matched, similarity, alignment),
        *_clock_metrics(estimate, truth, alignment),
        *segment_metrics(lengths),
        *own,
    ]
    return Assessment(tuple(metrics), aligned, lengths)


def _position_errors(aligned: Matched, alignment: AlignmentKind) -> list[Metric]:
    position = ate(aligned)
    how = ALIGNED[alignment]
    return [
        Metric("matched poses", len(aligned), "pairs"),
        Metric(ATE_RMSE, position.rmse, "m", how),
        Metric("ATE mean", position.mean, "m", how),
        Metric("ATE median", position.median, "m", how),
        Metric("ATE std", position.std, "m", how),
        Metric("ATE min", position.min, "m", how),
        Metric("ATE max", position.max, "m", how),
    ]


def _against_truth(aligned: Matched, alignment: AlignmentKind) -> list[Metric]:
    steps = rpe(aligned)
    return [
        *_position_errors(aligned, alignment),
        Metric(RPE_RMSE_M, steps.translation_m.rmse, "m", "consecutive"),
        Metric(RPE_RMSE_RAD, steps.rotation_rad.rmse, "rad", "consecutive"),
    ]


def _lever_metrics(matched: Matched, alignment: AlignmentKind) -> list[Metric]:
    """Return how far from the body's origin the point of the true positions seems to lie, and ATE with it."""
    lever, rmse_m = lever_arm(matched, alignment)
    return [Metric(LEVER_ARM, float(np.linalg.norm(lever)), "m"), Metric(ATE_WITH_LEVER_ARM, rmse_m, "m")]


def _alignment_metrics(matched: Matched, similarity: Similarity, alignment: AlignmentKind) -> list[Metric]:
    if alignment == "sim3":
        return [Metric("scale of the estimate", similarity.scale, "×")]
    if alignment == "yaw":  # large where one of the worlds does not have z up: then the errors mean nothing
        cosine = np.clip(align(matched, "se3").T_truth_map[2, 2], -1.0, 1.0)
        return [Metric("tilt that SE(3) would add", float(np.arccos(cosine)), "rad")]
    return []


def _clock_metrics(estimate: Trajectory, truth: Trajectory, alignment: AlignmentKind) -> list[Metric]:
    if not (have_clock(estimate.stamps_ns) and have_clock(truth.stamps_ns)):
        return []
    found = clock_offset(estimate, truth, alignment)
    if found is None:
        return []
    return [
        Metric(CLOCK_OFFSET, found.offset_s, "s"),
        Metric(ATE_WITHOUT_OFFSET, found.rmse_m, "m"),
    ]


def have_clock(stamps_ns: Stamps) -> bool:
    """Return whether stamps are times: numbers of poses, as KITTI text gets them, span less than any log."""
    return bool(stamps_ns[-1] - stamps_ns[0] >= _CLOCK_NS)


def _coverage(estimate: Trajectory, truth: Trajectory | None, frames_ns: Stamps | None) -> list[Metric]:
    if frames_ns is not None:
        return frame_coverage(frames_ns, estimate.stamps_ns)
    if truth is None or not have_clock(truth.stamps_ns):
        return []
    begin_ns, end_ns = int(truth.stamps_ns[0]), int(truth.stamps_ns[-1])
    return time_coverage(estimate.stamps_ns, begin_ns=begin_ns, end_ns=end_ns)


_KITTI_COLUMNS = 12


def estimate_and_truth(
    estimate: Estimate, truth: Trajectory | AnyPath | None, times: AnyPath | None
) -> tuple[Run | None, Trajectory, Trajectory | None]:
    """Return the run if it is one, the estimated poses, and the true ones, which may be its own.

    Args:
        estimate: Run folder or trajectory that is evaluated.
        truth: Trajectory that it is compared with.
        times: Seconds, one a line, of poses in KITTI text.

    Raises:
        RunError: A folder is no finished run.
        SourceError: A file cannot be read.
        DataError: It is malformed, or KITTI text and times do not belong together.
    """
    for name, one in (("estimate", estimate), ("truth", "" if truth is None else truth)):
        if not isinstance(one, Run | Trajectory | str | os.PathLike):
            raise DataError(f"{name}: {type(one).__name__}, want a Trajectory or the path of a file or run")
    paths = [Path(one) if isinstance(one, str | os.PathLike) else None for one in (estimate, truth)]
    untimed = [path for path in paths if path is not None and path.is_file() and _is_kitti(path)]
    if times is not None and not untimed:
        raise DataError(f"{times}: --times is for poses in KITTI text, which neither file is")
    if times is None and len(untimed) == 1 and truth is not None:
        raise DataError(f"{untimed[0]}: KITTI text has no stamps to pair poses by; give them with --times")
    known = truth
    if not (isinstance(known, Trajectory) or known is None):
        known = without_idle_rotations(_poses(known, times))
    if isinstance(estimate, Trajectory):
        return None, estimate, known
    if isinstance(estimate, str | os.PathLike):
        if Path(estimate).is_file():
            poses = _poses(estimate, times)
            if times is None and len(untimed) == 2 and known is not None and len(poses) != len(known):
                raise DataError(
                    f"{estimate} has {len(poses)} poses and {truth} {len(known)}: poses in KITTI text are "
                    "paired by line; cut the longer to the same frames"
                )
            return None, poses, known
        estimate = open_run(estimate)
    return estimate, estimate.trajectory, known or estimate.truth


def _is_kitti(path: Path) -> bool:
    """Return whether a file begins with a row-major 3×4 pose, which has no stamp."""
    try:
        _, words = next(rows(path), (0, []))
    except SourceError as error:
        raise SourceError(f"{error}; want poses as TUM or KITTI text") from None
    return len(words) == _KITTI_COLUMNS


def _poses(given: AnyPath, times: AnyPath | None) -> Trajectory:
    """Return a file's trajectory; stamps of KITTI text without times are 0, 1, 2 … ns, only an order."""
    path = Path(given)
    if not _is_kitti(path):
        return read_mulran(path) if is_mulran(path) else read_tum(path)
    if times is None:
        return read_kitti(path)
    stamps = [parse_stamp(words[0], where=f"{times}:{number}") for number, words in rows(Path(times))]
    return read_kitti(path, np.array(stamps, dtype=np.int64))
