"""Poses by a caller's function of frames."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from mapper.core.errors import DataError, FrameError, TrackingError
from mapper.core.frames import Frame
from mapper.core.geometry import Transform, is_rigid
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.runtime.progress import Progress
from mapper.sources.base import Log


def poses_of(track: Callable[[Frame], ArrayLike | None], log: Log, *, progress: Progress) -> Trajectory:
    """Return the poses that a function gives a log's frames, called once for each in time order.

    Args:
        track: Takes a frame; returns (4, 4) T_world_body, or None where there is none.
        log: The log; frames that cannot be read are left out.
        progress: Receives the stage and its counts.

    Raises:
        DataError: It returns something else.
        TrackingError: It places fewer than two frames.
    """
    poses: list[tuple[int, Transform]] = []
    with progress.stage("odometry") as report:
        for done, entry in enumerate(log.entries(), start=1):
            report(done, len(log))
            try:
                frame = entry.load()
            except FrameError:
                continue  # tracking reports it
            found = track(frame)
            if found is not None:
                poses.append((entry.stamp_ns, _rigid(found, entry.stamp_ns)))
    if len(poses) < 2:
        raise TrackingError(
            f"odometry: placed {len(poses)} of {len(log)} frames, want at least 2; it returns (4, 4), or None"
        )
    return trajectory_from(poses)


def _rigid(found: ArrayLike, stamp_ns: int) -> Transform:
    try:
        T_world_body = np.array(found, dtype=np.float64)
    except (TypeError, ValueError):
        T_world_body = np.empty(0)
    if T_world_body.shape != (4, 4):
        raise DataError(f"odometry: frame {stamp_ns}: a pose of shape {np.shape(T_world_body)}, want (4, 4)")
    if not is_rigid(T_world_body):
        raise DataError(f"odometry: frame {stamp_ns}: the pose is not a finite rigid motion")
    return T_world_body
