"""Evaluation of one trajectory: all its metrics, with truth or without."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evaluators.metrics.coverage import frame_coverage, time_coverage
from evaluators.metrics.metric import Metric
from evaluators.metrics.segments import LengthErrors, lengths_for, segment_errors, segment_metrics
from evaluators.metrics.trajectory import (
    AlignmentKind,
    Matched,
    Similarity,
    align,
    associate,
    ate,
    rpe,
    start_end_offset,
)
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory

ALIGNED = {
    "none": "not aligned",
    "yaw": "yaw-aligned",
    "se3": "SE(3)-aligned",
    "sim3": "Sim(3)-aligned",
}
_CLOCK_NS = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
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


def evaluate(
    estimate: Trajectory, truth: Trajectory | None, *, alignment: AlignmentKind = "se3"
) -> list[Metric]:
    """Return the numbers of ``assess``."""
    return list(assess(estimate, truth, alignment=alignment).metrics)


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

    The names state the alignment. RPE compares consecutive matched poses.

    Args:
        estimate: The trajectory.
        truth: True poses of the body, or None if they are not known.
        alignment: How the estimate is aligned with the truth first.
        frames_ns: Stamps of all frames of the log, of which the estimate should have poses; None takes the
            time that the truth covers instead.
        lengths_m: Of the segments of the relative errors; None chooses them by the length of the true path.
        max_gap_s: Largest time between an estimated pose and its true one.
        names: What to call the two in an error, for instance their file names.

    Raises:
        DataError: The estimate is empty, no stamps match, too few do, or a length is not > 0.
    """
    offset = start_end_offset(estimate)
    own = [
        *_coverage(estimate, truth, frames_ns),
        Metric("path length", estimate.path_length_m, "m"),
        Metric("start-to-end offset", offset.translation_m, "m"),
        Metric("start-to-end rotation", offset.rotation_rad, "rad"),
    ]
    if truth is None:
        return Assessment(tuple(own))
    matched = associate(estimate, truth, max_gap_s=max_gap_s, names=names)
    similarity = align(matched, alignment)
    aligned = similarity.moved(matched)
    lengths = segment_errors(aligned, lengths_for(truth.path_length_m) if lengths_m is None else lengths_m)
    metrics = [
        *_against_truth(aligned, alignment),
        *_alignment_metrics(matched, similarity, alignment),
        *segment_metrics(lengths),
        *own,
    ]
    return Assessment(tuple(metrics), aligned, lengths)


def _against_truth(aligned: Matched, alignment: AlignmentKind) -> list[Metric]:
    position, steps = ate(aligned), rpe(aligned)
    how = ALIGNED[alignment]
    return [
        Metric("matched poses", len(aligned), "pairs"),
        Metric(f"ATE RMSE, {how}", position.rmse, "m"),
        Metric(f"ATE mean, {how}", position.mean, "m"),
        Metric(f"ATE median, {how}", position.median, "m"),
        Metric(f"ATE std, {how}", position.std, "m"),
        Metric(f"ATE min, {how}", position.min, "m"),
        Metric(f"ATE max, {how}", position.max, "m"),
        Metric("RPE translation RMSE, consecutive", steps.translation_m.rmse, "m"),
        Metric("RPE rotation RMSE, consecutive", steps.rotation_rad.rmse, "rad"),
    ]


def _alignment_metrics(matched: Matched, similarity: Similarity, alignment: AlignmentKind) -> list[Metric]:
    if alignment == "sim3":
        return [Metric("scale of the estimate", similarity.scale, "×")]
    if alignment == "yaw":  # large where one of the worlds does not have z up: then the errors mean nothing
        cosine = np.clip(align(matched, "se3").T_truth_map[2, 2], -1.0, 1.0)
        return [Metric("tilt that SE(3) would add", float(np.arccos(cosine)), "rad")]
    return []


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
