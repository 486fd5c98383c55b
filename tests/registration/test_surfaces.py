"""Prepared clouds: the same as small_gicp's; and points without a surface."""

import numpy as np
import pytest
import small_gicp

from mapper.core.errors import DataError
from mapper.registration.planes import flat_cells
from mapper.registration.surfaces import prepared

VOXEL_M = 0.3


def yard(rng, n=30_000):
    """Ground that rises, a slanted wall and a cylinder about the origin, with 1 cm of noise."""
    x, y = rng.uniform(-8.0, 8.0, (2, n))
    ground = np.column_stack([x, y, 0.1 * x - 1.0])
    wall = np.column_stack([x, 6.0 + 0.2 * x, rng.uniform(-1.0, 3.0, n)])
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    pillar = np.column_stack([3.0 + np.cos(angle), -2.0 + np.sin(angle), rng.uniform(-1.0, 3.0, n)])
    points = np.concatenate([ground, wall, pillar])
    return (points + rng.normal(scale=0.01, size=points.shape)).astype(np.float32)


def test_points_and_normals_are_those_of_small_gicp():
    points = yard(np.random.default_rng(1))
    ours = prepared(points, voxel_m=VOXEL_M)
    theirs, _ = small_gicp.preprocess_points(points, VOXEL_M, 10, 1)

    index, distance_m = ours.nearest(theirs.points()[:, :3])
    same = distance_m < 1e-5  # theirs are means of at most 1024 points at a time

    assert same.mean() > 0.95
    dots = (ours.normals[index] * theirs.normals()[:, :3]).sum(axis=1)[same]
    assert (dots > 0.9999).mean() > 0.9


def test_normals_point_to_the_origin_and_have_unit_length():
    cloud = prepared(yard(np.random.default_rng(2)), voxel_m=VOXEL_M)
    assert np.allclose(np.linalg.norm(cloud.normals, axis=1), 1.0)
    assert ((cloud.normals * cloud.points).sum(axis=1) <= 0.0).all()


def test_what_shows_no_surface_has_no_normal():
    line = np.outer(np.arange(40.0), [1.0, 2.0, 0.5])
    assert not prepared(line, voxel_m=VOXEL_M).normals.any()
    assert not prepared(np.eye(3), voxel_m=VOXEL_M).normals.any()
    flat = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0), [2.0]), axis=-1).reshape(-1, 3)
    assert np.allclose(prepared(flat, voxel_m=VOXEL_M).normals, [0.0, 0.0, -1.0])


def test_an_empty_cloud_is_near_nothing():
    empty = prepared(np.empty((0, 3), np.float32), voxel_m=VOXEL_M)
    assert len(empty.points) == 0
    assert np.isinf(empty.nearest(np.zeros((4, 3)))[1]).all()


def test_points_beyond_exact_voxels_are_refused():
    with pytest.raises(DataError, match=r"900000 m is beyond 209715 m"):
        prepared(np.full((30, 3), 9e5, np.float32), voxel_m=0.2)


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
