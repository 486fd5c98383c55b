import numpy as np
import pytest

from mapper.export.voxels import outside


def geometry(corners, triangles):
    """Return the mesh's area and enclosed volume, lattice units."""
    a, b, c = np.moveaxis(corners[triangles].astype(np.float64), 1, 0)
    normals = np.cross(b - a, c - a)
    return np.linalg.norm(normals, axis=1).sum() / 2, np.einsum("ij,ij->", a, normals) / 6


def open_faces(keys):
    """Count the faces that no neighbour covers, one by one."""
    known = set(map(tuple, keys.tolist()))
    steps = np.vstack([np.eye(3, dtype=int), -np.eye(3, dtype=int)])
    return sum(tuple((key + step).tolist()) not in known for key in keys for step in steps)


def test_one_voxel_is_a_cube():
    corners, triangles = outside(np.array([[7, 8, 9]]))

    assert sorted(map(tuple, corners.tolist())) == [
        (x, y, z) for x in (7, 8) for y in (8, 9) for z in (9, 10)
    ]
    assert len(triangles) == 12
    assert geometry(corners, triangles) == (6.0, 1.0)


@pytest.mark.parametrize(("step", "triangles_wanted"), [([1, 0, 0], 12), ([0, 1, 0], 20), ([0, 0, 1], 28)])
def test_rows_of_faces_are_joined_along_one_horizontal_axis(step, triangles_wanted):
    corners, triangles = outside(np.array([5, 5, 5]) + np.arange(3)[:, None] * np.array(step))
    assert geometry(corners, triangles) == (14.0, 3.0)
    assert len(triangles) == triangles_wanted


@pytest.mark.parametrize("seed", range(5))
def test_the_surface_of_random_voxels_is_exact(seed):
    rng = np.random.default_rng(seed)
    keys = np.argwhere(rng.random((6, 7, 5)) < 0.4)

    area, volume = geometry(*outside(keys))

    assert area == open_faces(keys)
    assert volume == pytest.approx(len(keys))


def test_the_order_of_the_voxels_does_not_matter():
    rng = np.random.default_rng(0)
    keys = np.argwhere(rng.random((4, 4, 4)) < 0.5)
    for ours, theirs in zip(outside(keys), outside(rng.permutation(keys)), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_voxels_at_the_ends_of_the_key_range_are_not_neighbours():
    low, high = [0, 5, 5], [65535, 4, 5]
    area, volume = geometry(*outside(np.array([low, high, [0, 0, 0], [65535, 65535, 65535]])))
    assert area == 24
    assert volume == pytest.approx(4)
