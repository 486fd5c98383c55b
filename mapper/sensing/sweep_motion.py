"""Motion of the body during a sweep, by which its points are deskewed.

A module of its own, as deskewing imports numba, and most verbs read a gyroscope only to list it.
"""

import numpy as np

from mapper.core.deskew import STILL, Motion, SampledMotion, Twist, twist_at, twist_between
from mapper.core.frames import Scan
from mapper.core.geometry import Array, inverse, rotation_exp
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.sensing.gyroscope import Gyroscope
from mapper.sensing.wheel_kinematics import pose_at


def sampled_motion(
    gyroscope: Gyroscope, begin_ns: int, zero_ns: int, end_ns: int, velocity_mps: Array
) -> SampledMotion | None:
    """Return the body's motion during a sweep; None where the readings have a gap.

    Args:
        gyroscope: Readings of the body.
        begin_ns: Time of the first point.
        zero_ns: Time from which the motion is counted, not before that.
        end_ns: Time of the last point.
        velocity_mps: (3,) in the body's axes at ``zero_ns``.
    """
    first, last = np.searchsorted(gyroscope.stamps_ns, [begin_ns, end_ns])
    knots_ns = np.unique(np.concatenate([gyroscope.stamps_ns[first:last], [begin_ns, zero_ns, end_ns]]))
    steps, known = gyroscope.rotations(knots_ns[:-1], knots_ns[1:], np.zeros(3))
    if not len(steps) or not known.all():
        return None
    R = [np.eye(3)]
    for step in steps:
        R.append(R[-1] @ step)
    R_begin = np.array(R)
    R_begin_zero = R_begin[int(np.searchsorted(knots_ns, zero_ns))]
    return SampledMotion((knots_ns - zero_ns) / NS_PER_S, R_begin_zero.T @ R_begin, velocity_mps)


def motion_during(
    scan: Scan,
    trajectory: Trajectory,
    index: int,
    gyroscope: Gyroscope | None,
    wheels: Trajectory | None = None,
) -> Motion:
    """Return the body's motion during a scan, for deskewing: by the gyroscope, or by the poses around it.

    Of a planar scan it is that of the wheels, corrected by the velocity that these miss around it.

    Args:
        scan: The scan, as it was measured.
        trajectory: Poses of the body.
        index: Index of the scan's pose.
        gyroscope: Readings of the log; they count if they are of the body.
        wheels: T_odom_body of the log.
    """
    twist = twist_at(trajectory, index)
    if scan.is_planar and wheels is not None and scan.times_s is not None and len(scan.times_s):
        begin_ns, end_ns = _span_ns(scan)
        added = _slip(twist, trajectory, index, wheels)
        return motion_by_wheels(wheels, begin_ns, scan.stamp_ns, end_ns, added=added) or twist
    if gyroscope is None or not gyroscope.is_of_body or scan.times_s is None or not len(scan.times_s):
        return twist
    first, last = max(index - 1, 0), min(index + 1, len(trajectory) - 1)
    if first == last:
        return twist
    stamps_ns, poses = trajectory.stamps_ns, trajectory.T_world_body
    elapsed_s = float(stamps_ns[last] - stamps_ns[first]) / NS_PER_S
    velocity_mps = (poses[last, :3, 3] - poses[first, :3, 3]) @ poses[index, :3, :3] / elapsed_s
    begin_ns, end_ns = _span_ns(scan)
    measured = sampled_motion(gyroscope, begin_ns, scan.stamp_ns, end_ns, velocity_mps)
    return measured or twist


def _span_ns(scan: Scan) -> tuple[int, int]:
    """Return the times of the first and the last point of a scan with times, and of its stamp."""
    assert scan.times_s is not None
    first_s, last_s = min(float(scan.times_s.min()), 0.0), max(float(scan.times_s.max()), 0.0)
    return scan.stamp_ns + round(first_s * NS_PER_S), scan.stamp_ns + round(last_s * NS_PER_S)


def motion_by_wheels(
    wheels: Trajectory, begin_ns: int, zero_ns: int, end_ns: int, *, added: Twist = STILL
) -> SampledMotion | None:
    """Return the body's motion during a sweep by the wheels' readings; None outside of them, or in a gap.

    Args:
        wheels: T_odom_body.
        begin_ns: Time of the first point.
        zero_ns: Time from which the motion is counted.
        end_ns: Time of the last point.
        added: Velocity to be added to theirs.
    """
    first, last = np.searchsorted(wheels.stamps_ns, [begin_ns, end_ns])
    knots_ns = np.unique(np.concatenate([wheels.stamps_ns[first:last], [begin_ns, zero_ns, end_ns]]))
    poses = [pose_at(wheels, int(time_ns), max_gap_ns=NS_PER_S) for time_ns in knots_ns]
    known = [T for T in poses if T is not None]
    if len(known) < max(len(poses), 2):
        return None
    times_s = (knots_ns - zero_ns) / NS_PER_S
    T_zero = inverse(known[int(np.searchsorted(knots_ns, zero_ns))]) @ np.array(known)
    R = np.array(
        [T[:3, :3] @ rotation_exp(added.rotation_radps * t) for T, t in zip(T_zero, times_s, strict=True)]
    )
    velocity_mps = (T_zero[-1, :3, 3] - T_zero[0, :3, 3]) / (times_s[-1] - times_s[0])
    return SampledMotion(times_s, R, velocity_mps + added.translation_mps)


def _slip(twist: Twist, trajectory: Trajectory, index: int, wheels: Trajectory) -> Twist:
    """Return the velocity by the poses around one, less that by the wheels meanwhile."""
    around = trajectory.stamps_ns[[max(index - 1, 0), min(index + 1, len(trajectory) - 1)]].tolist()
    poses = [pose_at(wheels, time_ns, max_gap_ns=NS_PER_S) for time_ns in around]
    if around[0] == around[1] or poses[0] is None or poses[1] is None:
        return STILL
    rolled = twist_between(poses[0], poses[1], duration_s=(around[1] - around[0]) / NS_PER_S)
    return Twist.of(twist.vector - rolled.vector)
