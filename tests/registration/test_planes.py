"""Planes of one scan."""

import numpy as np

from mapper.registration.planes import flat_cells


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
