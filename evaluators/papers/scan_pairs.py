"""Pairs for registration without a guess: a scan in a frame of any yaw, and the map it belongs into."""

from collections.abc import Sequence

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Transform, apply, inverse, transform
from mapper.core.voxel_grid import thin

_RINGS, _KEPT_RINGS = 64, 16


def moved(scan: Scan, T_new_body: Transform) -> Scan:
    """Return a scan in the coordinates of another frame."""
    return Scan(
        stamp_ns=scan.stamp_ns,
        points_body=apply(T_new_body, scan.points_body.astype(np.float64)).astype(np.float32),
        origin_body=apply(T_new_body, scan.origin_body[np.newaxis])[0],
    )


def perturbed(
    scan: Scan,
    T_world_body: Transform,
    T_world_target: Transform,
    rng: np.random.Generator,
    *,
    offset_m: float,
) -> tuple[Scan, Transform]:
    """Return a scan in a frame of any yaw, at most so far from the target, and that frame's pose."""
    yaw, bearing = rng.uniform(-np.pi, np.pi, 2)
    reach_m = offset_m * np.sqrt(rng.random())
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ T_world_body[:3, :3]
    x, y = T_world_target[:2, 3] + reach_m * np.array([np.cos(bearing), np.sin(bearing)])
    T_world_new = transform(R, np.array([x, y, T_world_body[2, 3]]))
    return moved(scan, inverse(T_world_new) @ T_world_body), T_world_new


def fewer_rings(scan: Scan) -> Scan:
    """Return every fourth of 64 rings, by elevation: about what a VLP-16 would have seen."""
    x, y, z = scan.points_body.T
    elevation = np.arctan2(z, np.hypot(x, y))
    low, high = np.percentile(elevation, [0.5, 99.5])
    keep = ((elevation - low) / (high - low) * _RINGS).astype(int) % (_RINGS // _KEPT_RINGS) == 0
    return Scan(stamp_ns=scan.stamp_ns, points_body=scan.points_body[keep], origin_body=scan.origin_body)


def merged(scans: Sequence[Scan], T_map_body: Sequence[Transform], *, voxel_m: float) -> Scan:
    """Return a map of scans, one point per voxel, as if it had been seen from its origin."""
    points = np.concatenate(
        [
            apply(T, scan.points_body.astype(np.float64)).astype(np.float32)
            for scan, T in zip(scans, T_map_body, strict=True)
        ]
    )
    return Scan(stamp_ns=0, points_body=points[thin(points, voxel_m)])
