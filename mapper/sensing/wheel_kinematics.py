"""Wheel kinematics: poses from encoders and steering, and the pose and the path at any time."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, exp, inverse, log
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory

_TIMES_FASTER = 10.0
"""A step that is this many times as long and as fast as 95 % of all steps is no motion of wheels, which speed
up over many steps."""
_LEAST_JUMP = {"m": 0.2, "rad": 0.2}
_LEAST_SPEED = {"m": 5.0, "rad": 10.0}
"""Per second, of robots that stand still for nearly all of the log."""


def driven(stamps_ns: Stamps, path_m: Array, steering_rad: Array, *, wheelbase_m: float) -> Trajectory:
    """Integrate the bicycle model: the turn per metre is tan(steering) / wheelbase (LaValle 2006, §13.1.2.1).

    Between two readings the turn per metre is the mean of theirs, so that the path is an arc.

    Args:
        stamps_ns: (N,) increasing times of the readings.
        path_m: (N,) encoder's distance of the rear axle, from any origin; it decreases in reverse.
        steering_rad: (N,) angle of the front wheel, positive to the left.
        wheelbase_m: Distance between the axles.

    Returns:
        T_odom_base of the middle of the rear axle, x forward, y left, z up; it begins at the identity.
    """
    curvature_rad_per_m = np.tan(steering_rad) / wheelbase_m
    T_odom_base = [np.eye(4)]
    for (begin_m, end_m), (begin, end) in zip(pairwise(path_m), pairwise(curvature_rad_per_m), strict=True):
        step_m = end_m - begin_m
        turn_rad = 0.5 * (begin + end) * step_m
        step = exp(np.array([0.0, 0.0, turn_rad]), np.array([step_m, 0.0, 0.0]))
        T_odom_base.append(T_odom_base[-1] @ step)
    return Trajectory(stamps_ns, np.array(T_odom_base))


def pose_at(wheels: Trajectory, stamp_ns: int, *, max_gap_ns: int) -> Transform | None:
    """Return T_odom_body at a time; None outside the readings, or in a gap of more than ``max_gap_ns``."""
    stamps_ns = wheels.stamps_ns
    before, after = np.searchsorted(stamps_ns, stamp_ns, "right") - 1, np.searchsorted(stamps_ns, stamp_ns)
    if before < 0 or after == len(wheels) or stamps_ns[after] - stamps_ns[before] > max_gap_ns:
        return None
    return wheels.at(stamp_ns)


def without_jumps(wheels: Trajectory) -> tuple[Trajectory, list[str]]:
    """Return odometry without its jumps, as it has them where it was restarted, and a note on these.

    A step that jumps gets the velocity of the step before.
    """
    seconds = np.diff(wheels.stamps_ns) / NS_PER_S
    steps_m, steps_rad = step_sizes(wheels)
    jumps = np.flatnonzero(_jumps(steps_m, seconds, "m") | _jumps(steps_rad, seconds, "rad"))
    poses = wheels.T_world_body.copy()
    for i in jumps.tolist():
        step = np.eye(4)
        if i > 0:
            rotation_rad, translation_m = log(inverse(poses[i - 1]) @ poses[i])
            ratio = seconds[i] / seconds[i - 1]
            step = exp(ratio * rotation_rad, ratio * translation_m)
        poses[i + 1 :] = poses[i] @ step @ inverse(poses[i + 1]) @ poses[i + 1 :]
    if not len(jumps):
        return wheels, []
    first = jumps[0]
    return Trajectory(wheels.stamps_ns, poses), [
        f"wheel odometry: it jumps {len(jumps)} times, first by {steps_m[first]:.2f} m and "
        f"{np.degrees(steps_rad[first]):.0f}° within {seconds[first]:.3f} s, as if restarted; jumps are "
        "left out"
    ]


def _jumps(sizes: Array, seconds: Array, unit: str) -> NDArray[np.bool_]:
    speeds = sizes / seconds
    longest, fastest = (
        _TIMES_FASTER * np.percentile(one, 95.0) if len(one) else 0.0 for one in (sizes, speeds)
    )
    is_jump: NDArray[np.bool_] = (sizes > max(longest, _LEAST_JUMP[unit])) & (
        speeds > max(fastest, _LEAST_SPEED[unit])
    )
    return is_jump


def step_sizes(wheels: Trajectory) -> tuple[Array, Array]:
    """Return the (N - 1,) metres and the radians between consecutive poses of N."""
    steps_m = np.linalg.norm(np.diff(wheels.positions_world, axis=0), axis=1)
    chords = np.linalg.norm(np.diff(wheels.T_world_body[:, :3, :3], axis=0), axis=(1, 2))
    # |R_a − R_b|_F = √8 sin(angle / 2)
    return steps_m, 2.0 * np.arcsin(np.minimum(chords / np.sqrt(8.0), 1.0))


class Odometer:
    """Path length and total turn of the wheels' poses, in either direction."""

    def __init__(self, wheels: Trajectory) -> None:
        """Sum the distances and angles between consecutive poses."""
        self._start_ns = int(wheels.stamps_ns[0])  # nanoseconds since 1970 are too many for a float
        self._since_start_ns = (wheels.stamps_ns - self._start_ns).astype(np.float64)
        self._counts = [np.concatenate([[0.0], np.cumsum(steps)]) for steps in step_sizes(wheels)]

    def between(self, begin_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the metres driven and the radians turned from one time to a later one."""
        span_ns = np.array([begin_ns - self._start_ns, end_ns - self._start_ns], dtype=np.float64)
        path_m, turn_rad = (
            np.diff(np.interp(span_ns, self._since_start_ns, count)) for count in self._counts
        )
        return float(path_m[0]), float(turn_rad[0])
