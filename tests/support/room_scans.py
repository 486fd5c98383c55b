"""Simulated scans of a room, and keyframes of them."""

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.odometry.scans.scan_fit import ScanKeyframe
from mapper.odometry.scans.scan_matcher import DeskewedScan
from mapper.registration.surfaces import prepared

INDOOR = GicpOdometryConfig(voxel_m=0.2, cell_m=0.25, coarse_cell_m=1.0, min_range_m=0.3, rescue=None)
ROOM = np.array([[-4.0, 4.0], [-3.0, 3.0], [-1.2, 1.6]])
CRATES = (
    np.array([[-2.5, -1.2], [0.6, 2.0], [-1.2, 1.0]]),
    np.array([[-1.0, 0.8], [-1.8, -0.8], [-1.2, 1.6]]),
)
OFF = exp(np.array([0.0, 0.0, np.radians(15.0)]), np.array([0.5, 0.3, 0.0]))


def room_scan(stamp_ns, T_world_body=None, *, seed=0, points=6000, noise_m=0.02, more=()):
    """Return what is seen of a room with a pillar, a cupboard and more boxes, by rays from the body."""
    rng = np.random.default_rng(seed)
    T_world_body = np.eye(4) if T_world_body is None else T_world_body
    pillar = np.array([[1.2, 1.8], [0.8, 1.5], [-1.2, 1.6]])
    cupboard = np.array([[-3.9, -3.1], [-2.9, -1.0], [-1.2, 0.6]])
    directions = rng.normal(size=(points, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    rays, origin = directions @ T_world_body[:3, :3].T, T_world_body[:3, 3]
    ranges = np.full(points, np.inf)
    for number, box in enumerate((ROOM, pillar, cupboard, *more)):
        with np.errstate(divide="ignore"):
            ends = (box.T[:, None, :] - origin) / rays
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        if number == 0:
            ranges = np.minimum(ranges, leave)
        else:
            ranges = np.where((enter < leave) & (enter > 0.0), np.minimum(ranges, enter), ranges)
    measured = directions * (ranges + rng.normal(0.0, noise_m, points))[:, None]
    return Scan(stamp_ns, measured.astype(np.float32))


def keyframe(scan, *, voxel_m=0.2):
    deskewed = DeskewedScan(scan, prepared(scan.points_body, voxel_m=voxel_m, origin=scan.origin_body))
    return ScanKeyframe(0, deskewed, np.eye(4), np.eye(4))
