"""Readings of a 2D laser as a planar scan of its robot."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, apply
from mapper.core.trajectory import Trajectory
from mapper.sensing.wheel_kinematics import without_jumps

MAX_TILT_RAD = np.radians(5.0)
"""A plane tilted by less is taken as parallel to the floor: what is measured 10 m away is 4 cm nearer."""

_TIMES_FARTHEST = 10.0
"""Ratio of the nearest range to the largest that is possible from which they are in different units."""
MOST_RAD = 4.0 * np.pi
"""Angle of a scan that is no damage: that of two turns."""


def beam_points(
    ranges_m: Array, *, first_rad: float, step_rad: float, limits_m: tuple[float, float]
) -> tuple[Array, NDArray[np.intp]]:
    """Return the (M, 3) returns of some beams in the laser's plane, z = 0, and (M,) the beams that have one.

    Args:
        ranges_m: (N,) in the order of the beams. What is not finite, or outside the limits, is no return.
        first_rad: Direction of the first beam, from x to y.
        step_rad: From each beam to the next.
        limits_m: Least and largest range; many drivers write the largest itself where nothing returns.
    """
    with np.errstate(invalid="ignore"):  # damaged numbers may be signalling NaN
        ranges_m = np.asarray(ranges_m, np.float64)
        is_return = (ranges_m > 0.0) & (ranges_m >= limits_m[0]) & (ranges_m < limits_m[1])
    beams = np.flatnonzero(is_return & np.isfinite(ranges_m))
    directions = first_rad + step_rad * beams
    plane = ranges_m[beams, None] * np.column_stack([np.cos(directions), np.sin(directions)])
    return np.column_stack([plane, np.zeros(len(beams))]), beams


def laser_records(
    ranges_m: Array,
    *,
    first_rad: float,
    step_rad: float,
    limits_m: tuple[float, float] = (0.0, np.inf),
    step_s: float = 0.0,
    intensities: Array,
) -> NDArray[np.void]:
    """Return the same as (M,) records of x, y and z, with intensity and time after the first where known.

    Raises:
        DataError: The directions are no numbers, all the same, or of more than two turns.
    """
    is_one = step_rad == 0.0 and len(ranges_m) > 1
    if is_one or not np.isfinite([first_rad, step_rad]).all() or abs(step_rad) * len(ranges_m) > MOST_RAD:
        raise DataError(
            f"{len(ranges_m)} beams from {first_rad:g} rad by {step_rad:g} rad: no laser's directions; "
            "want radians, and a step that is not 0"
        )
    with np.errstate(invalid="ignore"):
        found_m = ranges_m[np.isfinite(ranges_m) & (np.asarray(ranges_m) > 0.0)]
    if len(found_m) and found_m.min() > _TIMES_FARTHEST * limits_m[1] > 0.0:
        raise DataError(
            f"ranges of {found_m.min():g} to {found_m.max():g} m, range_max is {limits_m[1]:g} m; are they "
            "millimetres? want metres"
        )
    points, beams = beam_points(ranges_m, first_rad=first_rad, step_rad=step_rad, limits_m=limits_m)
    columns = dict(zip("xyz", points.T, strict=True))
    if len(intensities) == len(ranges_m):
        columns["intensity"] = np.asarray(intensities)[beams]
    if step_s > 0.0:
        columns["time"] = step_s * beams
    records = np.empty(len(beams), [(name, "<f4") for name in columns])
    with np.errstate(over="ignore", invalid="ignore"):  # what is too far is left out later
        for name, values in columns.items():
            records[name] = values
    return records


def tilt_rad(T_body_laser: Transform) -> float:
    """Return the angle between a laser's plane and that of the body's x and y; 0 also for one upside down."""
    return float(np.arccos(np.clip(abs(T_body_laser[2, 2]), 0.0, 1.0)))


def planar(scan: Scan) -> Scan:
    """Return a scan of a laser whose plane is nearly parallel to the body's x and y, in a plane that is."""
    points = scan.points_body.copy()
    points[:, 2] = scan.origin_body[2]
    return Scan(
        scan.stamp_ns,
        points,
        scan.origin_body,
        times_s=scan.times_s,
        intensities=scan.intensities,
        is_planar=True,
    )


def rolling(wheels: Trajectory | None) -> tuple[Trajectory | None, list[str]]:
    """Return wheel odometry that moves, without its jumps, and a note on these, or where it does not move."""
    if wheels is not None and wheels.path_length_m > 0.0:
        return without_jumps(wheels)
    what = "no wheel odometry" if wheels is None else "the wheel odometry stands still"
    return None, [f"{what}: it would show motions that walls do not; record /odom or /tf"]


def planar_scan(stamp_ns: int, points_laser: Array, T_body_laser: Transform) -> Scan:
    """Return the planar scan of (N, 3) points of a laser mounted at a pose on the body."""
    points_body = apply(T_body_laser, points_laser).astype(np.float32)
    return planar(Scan(stamp_ns, points_body, T_body_laser[:3, 3]))
