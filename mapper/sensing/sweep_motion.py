"""Motion of the body during a sweep, by which its points are deskewed.

A module of its own, as deskewing imports numba, and most verbs read a gyroscope only to list it.
"""

import numpy as np

from mapper.core.deskew import Motion, SampledMotion, twist_at
from mapper.core.frames import Scan
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.sensing.gyroscope import Gyroscope


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


def motion_during(scan: Scan, trajectory: Trajectory, index: int, gyroscope: Gyroscope | None) -> Motion:
    """Return the body's motion during a scan, for deskewing: by the gyroscope, or by the poses around it.

    Args:
        scan: The scan, as it was measured.
        trajectory: Poses of the body.
        index: Index of the scan's pose.
        gyroscope: Readings of the log; they count if they are of the body.
    """
    twist = twist_at(trajectory, index)
    if gyroscope is None or not gyroscope.is_of_body or scan.times_s is None or not len(scan.times_s):
        return twist
    first, last = max(index - 1, 0), min(index + 1, len(trajectory) - 1)
    if first == last:
        return twist
    stamps_ns, poses = trajectory.stamps_ns, trajectory.T_world_body
    elapsed_s = float(stamps_ns[last] - stamps_ns[first]) / NS_PER_S
    velocity_mps = (poses[last, :3, 3] - poses[first, :3, 3]) @ poses[index, :3, :3] / elapsed_s
    begin_ns, end_ns = (
        scan.stamp_ns + round(float(time_s) * NS_PER_S) for time_s in (scan.times_s.min(), scan.times_s.max())
    )
    zero_ns = scan.stamp_ns
    measured = sampled_motion(gyroscope, min(begin_ns, zero_ns), zero_ns, max(end_ns, zero_ns), velocity_mps)
    return measured or twist
