"""Planes of one scan, and the vertical that they show."""

import numpy as np
import pytest

from mapper.core.geometry import apply, exp, turn_to_z
from mapper.registration.planes import flat_cells, up_of
from mapper.registration.surfaces import prepared
from tests.support.room_scans import room_scan

Z = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.7), (0.35, 0.0, 1.2), (-0.2, 0.3, 0.0)])
def test_a_room_shows_the_vertical_of_a_tilted_scan(tilt):
    T_body_level = exp(np.array(tilt), np.zeros(3))
    points = apply(T_body_level, room_scan(0, seed=1).points_body.astype(np.float64))

    up = up_of(prepared(points, voxel_m=0.2))

    assert np.degrees(np.arccos(up @ T_body_level[:3, :3] @ Z)) < 0.5
    np.testing.assert_allclose(turn_to_z(up) @ up, Z, atol=1e-12)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.random.default_rng(1).normal(size=(4000, 3))])
def test_points_without_planes_show_none(points):
    assert up_of(prepared(points, voxel_m=0.2)) is None


def test_cells_are_flat_by_their_thickness_their_breadth_and_their_points():
    middle = np.array([3.7, 3.2, 0.25])  # of a cell of 0.49 m, a tenth of its distance
    offsets = np.random.default_rng(2).uniform(-0.1, 0.1, (200, 3))
    offsets -= offsets.mean(axis=0)

    def found(scale, points=200):
        return len(flat_cells(middle + offsets[:points] * scale, 0.02)[0])

    assert found([0.1, 1.0, 1.0]) == 1
    assert found([0.6, 2.0, 2.0]) == 0, "thicker than the tolerance"
    assert found([0.3, 0.5, 0.5]) == 0, "thinner than the tolerance, but not for its size"
    assert found([0.02, 0.15, 1.0]) == 0, "a line"
    assert found([0.0, 1.0, 1.0], points=7) == 0
    centres, normals = flat_cells(middle + offsets * [0.0, 1.0, 1.0], 0.02)
    np.testing.assert_allclose(centres, [middle], atol=1e-9)
    np.testing.assert_allclose(normals, [[-1.0, 0.0, 0.0]], atol=1e-9)
