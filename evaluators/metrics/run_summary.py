"""Summary of a run in one row, for tables of many."""

import numpy as np

from mapper.core.errors import DataError
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.odometry import ONE_SECOND, PathErrors, path_errors
from mapper.evaluators.metrics.segments import lengths_for, segment_errors
from mapper.evaluators.metrics.trajectory import AlignmentKind, Matched, align, associate, start_end_offset
from mapper.evaluators.tables.table import Value
from mapper.run.folder import Run


def summary(run: Run, *, alignment: AlignmentKind = "se3") -> dict[str, Value]:
    """Return the errors of a run's path, and which share of its log has poses; None is not known.

    Nothing is known of the errors where the log has no truth or too few poses have one, nothing of those over
    a second or over stretches of the path where there are none. ``relative_…`` are means over the
    segments of :func:`mapper.evaluators.metrics.segments.lengths_for`, as KITTI's table has them.

    Args:
        run: A finished run.
        alignment: Alignment of its path with the truth.
    """
    counts, trajectory, truth = run.manifest.counts, run.trajectory, run.truth
    matched = None if truth is None else _aligned(trajectory, truth, alignment)
    errors = PathErrors() if matched is None else path_errors(matched, ONE_SECOND)
    relative = _relative(matched, 0.0 if truth is None else truth.path_length_m)
    return {
        "listed_frames": counts.listed,
        "tracked_frames": counts.tracked,
        "doubtful_frames": counts.doubtful,
        "coverage_ratio": counts.tracked / counts.listed if counts.listed else None,
        "matched_poses": 0 if matched is None else len(matched),
        "ate_m": errors.ate_m,
        "rpe_1s_m": errors.rpe_m,
        "rpe_1s_rad": errors.rpe_rad,
        "relative_translation_ratio": relative[0],
        "relative_rotation_radpm": relative[1],
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


def _relative(matched: Matched | None, path_m: float) -> tuple[float, float] | tuple[None, None]:
    """Return the mean relative errors of translation and rotation over all segments."""
    lengths = () if matched is None else segment_errors(matched, lengths_for(path_m))
    if not any(map(len, lengths)):
        return None, None
    translation = np.concatenate([length.translation_ratio for length in lengths])
    rotation = np.concatenate([length.rotation_radpm for length in lengths])
    return float(translation.mean()), float(rotation.mean())
