import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import apply, inverse, rotation_exp, transform
from mapper.mapping.floor_planes import floor_plane

UP_BODY = np.array([0.0, -1.0, 0.0])


def scan_of(*heights_m, tilt_deg=0.0):
    """What a camera at the height of 1.4 m sees of level squares 1 to 3 m before it; y is down."""
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-1.0, 1.0, 60), np.linspace(1.0, 3.0, 60)))
    rng = np.random.default_rng(0)
    squares = [np.column_stack([x, 1.4 - height + rng.normal(0, 0.004, len(x)), z]) for height in heights_m]
    T_body_level = transform(rotation_exp(np.array([np.radians(tilt_deg), 0.0, 0.0])), np.zeros(3))
    points = apply(T_body_level, np.concatenate(squares))
    return Scan(0, points.astype(np.float32), np.zeros(3)), T_body_level


@pytest.mark.parametrize("heights_m", [(0.0,), (0.0, 0.75)])
def test_the_lowest_level_plane_is_the_floor(heights_m):
    scan, T_body_level = scan_of(*heights_m, tilt_deg=6.0)
    T_body_floor = floor_plane(scan, UP_BODY, tolerance_m=0.03)
    up_level = T_body_level[:3, :3].T @ T_body_floor[:3, 2]
    assert np.degrees(np.arccos(up_level @ UP_BODY)) < 0.3
    assert inverse(T_body_floor)[2, 3] == pytest.approx(1.4, abs=0.01)


def test_neither_a_ramp_nor_a_ledge_is_a_floor():
    ramp, _ = scan_of(0.0, tilt_deg=20.0)
    ledge, _ = scan_of(1.3)
    assert floor_plane(ramp, UP_BODY, tolerance_m=0.03) is None
    assert floor_plane(ledge, UP_BODY, tolerance_m=0.03) is None
