"""Gravity's direction by an accelerometer, in the world of a path."""

import numpy as np

from mapper.core.geometry import Array, stride_for
from mapper.core.rotations import right_angled_frames
from mapper.core.timebase import nearest
from mapper.core.trajectory import Trajectory
from mapper.registration.planes import MAX_TILT_RAD, PARALLEL_RAD
from mapper.sources.base import Accelerations

_MAX_READING_GAP_NS = 50_000_000
_MIN_READINGS = 50
_MAX_READINGS = 5000
_MAX_SPREAD_RAD = np.radians(20.0)
_CLEAR_SPREAD_RATIO = 1.25


def up_in_stated_axes(accelerations: Accelerations | None, trajectory: Trajectory) -> Array | None:
    """Return (3,) up by an accelerometer in the body's axes; None where these are not known, or up not clear.

    Args:
        accelerations: Readings of the log, if it has any.
        trajectory: Poses of the body.
    """
    if accelerations is None or not accelerations.are_axes_stated:
        return None
    readings, R_world_body = _matched_readings(accelerations, trajectory)
    if len(readings) < _MIN_READINGS:
        return None
    up_world, spread_rad = _mean_direction(readings, R_world_body)
    return up_world if spread_rad <= _MAX_SPREAD_RAD else None


def up_by_accelerometer(
    accelerations: Accelerations, trajectory: Trajectory, up_guess: Array
) -> tuple[Array | None, str]:
    """Return the mean direction of the readings in the world, or None, and the detail or the reason.

    The accelerometer's axes are right-angled to the body's; with the right ones gravity keeps its direction
    in the world while the body turns.

    Args:
        accelerations: Readings of the log.
        trajectory: Poses of the body.
        up_guess: (3,) direction within 60° of which up is, world frame.
    """
    readings, R_world_body = _matched_readings(accelerations, trajectory)
    if len(readings) < _MIN_READINGS:
        return None, f"accelerometer: only {len(readings)} readings near a pose, want {_MIN_READINGS}"
    found = []
    for R_body_sensor in right_angled_frames():
        mean, spread_rad = _mean_direction(readings @ R_body_sensor.T, R_world_body)
        if mean @ up_guess > np.cos(MAX_TILT_RAD):
            found.append((spread_rad, mean))
    if not found:
        return None, "accelerometer: no axes put up within 60° of the camera's"
    found.sort(key=lambda one: one[0])
    spread_rad, up_world = found[0]
    if spread_rad > _MAX_SPREAD_RAD:
        return (
            None,
            f"accelerometer: readings spread over {np.degrees(spread_rad):.0f}°, at most 20° is usable",
        )
    others = [spread for spread, up in found if up @ up_world < np.cos(PARALLEL_RAD)]
    if others and others[0] < _CLEAR_SPREAD_RATIO * spread_rad:
        stated_up, stated_spread_rad = _mean_direction(readings, R_world_body)
        is_possible = stated_up @ up_guess > np.cos(MAX_TILT_RAD)
        if accelerations.are_axes_stated and is_possible and stated_spread_rad <= _MAX_SPREAD_RAD:
            detail = f"{len(readings)} accelerometer readings in the axes that the log states"
            return stated_up, f"{detail}, spread over {np.degrees(stated_spread_rad):.1f}°"
        return None, "accelerometer: its axes are ambiguous because the body hardly turned"
    return up_world, f"{len(readings)} accelerometer readings spread over {np.degrees(spread_rad):.1f}°"


def _mean_direction(readings: Array, R_world_body: Array) -> tuple[Array, float]:
    """Return the mean direction of (N, 3) readings in the world, and their RMS angle from it, rad."""
    directions_world = np.einsum("nij,nj->ni", R_world_body, readings)
    mean = directions_world.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    angles = np.arccos(np.clip(directions_world @ mean, -1.0, 1.0))
    return mean, float(np.sqrt(np.mean(angles**2)))


def _matched_readings(accelerations: Accelerations, trajectory: Trajectory) -> tuple[Array, Array]:
    """Return (N, 3) unit readings and the (N, 3, 3) rotation R_world_body at their time.

    Readings far from the median length are left out: the body accelerates.
    """
    stride = stride_for(len(accelerations.stamps_ns), _MAX_READINGS)
    stamps_ns = accelerations.stamps_ns[::stride]
    readings = accelerations.acceleration_mps2[::stride]
    lengths = np.linalg.norm(readings, axis=1)
    usable = np.isfinite(lengths) & (lengths > 0.0)
    if not usable.any():
        return np.empty((0, 3)), np.empty((0, 3, 3))
    median = np.median(lengths[usable])
    pose, gap_ns = nearest(trajectory.stamps_ns, stamps_ns)
    usable &= (np.abs(lengths - median) <= 0.2 * median) & (gap_ns <= _MAX_READING_GAP_NS)
    return readings[usable] / lengths[usable, None], trajectory.T_world_body[pose[usable], :3, :3]
