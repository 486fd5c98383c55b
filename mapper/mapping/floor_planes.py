"""Floor planes: the floor as single frames see it, relative to the sensor's body."""

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, transform
from mapper.core.subsampling import stride_for
from mapper.registration.planes import flat_cells, levels_of

_REACH_M = 5.0
"""Farther away depth errors bend the floor by more than its tilt."""
_POINTS = 8000
_LEVEL_COSINE = np.cos(np.radians(15.0))
"""A pose and a vertical that have drifted are off by a few degrees."""
_MIN_HEIGHT_M = 0.25
_MIN_PATCHES = 20
_MIN_BREADTH_M = 0.15
"""Standard deviation of the patches' centres across the floor: a narrow strip shows no tilt."""
_TOLERANCES_M = (0.15, 0.1, 0.075, 0.06, 0.06)
"""Distance of patches from the plane, by iteration, while its tilt is refined."""


def floor_plane(scan: Scan, up_body: Array, *, tolerance_m: float) -> Transform | None:
    """Return the lowest level plane below the sensor in one scan.

    Args:
        scan: A frame's returns.
        up_body: (3,) unit vector, roughly up, body frame.
        tolerance_m: Largest standard deviation of a patch's points from its plane.

    Returns:
        (4, 4) T_body_floor: z is the plane's normal, and the origin lies in it, below the body's. None if the
        scan shows no such plane, or too little of it.
    """
    points = scan.points_body - scan.origin_body
    points = points[np.einsum("ij,ij->i", points, points) < _REACH_M**2]
    points = points[:: stride_for(len(points), _POINTS)].astype(np.float64)
    if len(points) < _MIN_PATCHES:
        return None
    centres, normals = flat_cells(points, tolerance_m)
    centres = centres[normals @ up_body > _LEVEL_COSINE]
    heights_m = centres @ up_body
    surfaces = levels_of(heights_m, tolerance_m=_TOLERANCES_M[0], least=_MIN_PATCHES)
    below_m = [float(np.median(heights_m[members])) for members in surfaces]
    below_m = [height_m for height_m in below_m if height_m < -_MIN_HEIGHT_M]
    if not below_m:
        return None
    up, height_m = up_body, min(below_m)
    for within_m in _TOLERANCES_M:
        members = centres[np.abs(centres @ up - height_m) <= within_m]
        if len(members) < _MIN_PATCHES:
            return None
        variances, axes = np.linalg.eigh(np.cov(members.T))
        if variances[1] < _MIN_BREADTH_M**2:
            return None
        up = axes[:, 0] * np.sign(axes[:, 0] @ up_body)
        height_m = float(members.mean(axis=0) @ up)
    return frame_of_plane(up, height_m + float(scan.origin_body @ up))


def frame_of_plane(normal: Array, distance_m: float) -> Transform:
    """Return the (4, 4) frame in a plane normal · x = distance_m: z along the normal, below the origin."""
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    x = across / np.linalg.norm(across)
    return transform(np.column_stack([x, np.cross(normal, x), normal]), distance_m * normal)
