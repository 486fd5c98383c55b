"""A run in one row, for tables of many."""

import numpy as np

from evaluators.metrics.odometry import ONE_SECOND
from evaluators.metrics.segments import lengths_for, segment_errors
from evaluators.metrics.trajectory import (
    AlignmentKind,
    Matched,
    align,
    associate,
    ate,
    start_end_offset,
    statistics,
    step_errors,
)
from evaluators.tables.table import Value
from mapper.core.errors import DataError
from mapper.core.trajectory import Trajectory
from mapper.run.folder import Run


def summary(run: Run, *, alignment: AlignmentKind = "se3") -> dict[str, Value]:
    """Return what a run's path is worth, and of how much of its log; None is not known.

    Nothing is known of the errors where the log has no truth or too few poses have one, nothing of those over
    a second or over stretches of the path where there are none. ``relative_…`` are means over the
    segments of :func:`evaluators.metrics.segments.lengths_for`, as KITTI's table has them.

    Args:
        run: A finished run.
        alignment: How its path is laid over the truth.
    """
    counts, trajectory, truth = run.manifest.counts, run.trajectory(), run.truth()
    matched = None if truth is None else _aligned(trajectory, truth, alignment)
    return {
        "listed_frames": counts.listed,
        "tracked_frames": counts.tracked,
        "coverage_ratio": counts.tracked / counts.listed if counts.listed else None,
        "matched_poses": 0 if matched is None else len(matched),
        "ate_m": None if matched is None else ate(matched).rmse,
        **_relative(matched, 0.0 if truth is None else truth.path_length_m),
        "path_m": trajectory.path_length_m,
        "start_to_end_m": start_end_offset(trajectory).translation_m,
        "loops": counts.loops,
    }


def _aligned(trajectory: Trajectory, truth: Trajectory, alignment: AlignmentKind) -> Matched | None:
    try:
        matched = associate(trajectory, truth)
        return align(matched, alignment).moved(matched)
    except DataError:
        return None


def _relative(matched: Matched | None, path_m: float) -> dict[str, Value]:
    found: dict[str, Value] = dict.fromkeys(
        ("rpe_1s_m", "rpe_1s_rad", "relative_translation_ratio", "relative_rotation_radpm")
    )
    if matched is None:
        return found
    try:
        steps_m, steps_rad = step_errors(matched, delta=ONE_SECOND.delta, unit=ONE_SECOND.unit)
        found |= {"rpe_1s_m": statistics(steps_m).rmse, "rpe_1s_rad": statistics(steps_rad).rmse}
    except DataError:
        pass
    lengths = segment_errors(matched, lengths_for(path_m))
    if any(map(len, lengths)):
        translation = np.concatenate([length.translation_ratio for length in lengths])
        rotation = np.concatenate([length.rotation_radpm for length in lengths])
        found |= {
            "relative_translation_ratio": float(translation.mean()),
            "relative_rotation_radpm": float(rotation.mean()),
        }
    return found
