"""Inputs of an evaluation: a run, a trajectory or a file of poses, and the truth."""

import os
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError, SourceError
from mapper.core.trajectory import Trajectory
from mapper.run.folder import Run, open_run
from mapper.runtime.regular_files import AnyPath
from mapper.sources.text import parse_stamp, rows
from mapper.sources.trajectory_files import is_mulran, read_kitti, read_mulran, read_tum

Estimate = Run | Trajectory | AnyPath
"""A run or its folder, a trajectory, or a file of TUM, EuRoC, MulRan or KITTI text."""

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
    known = truth if isinstance(truth, Trajectory) or truth is None else _poses(truth, times)
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
