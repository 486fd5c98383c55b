"""The kernels of a scan's fit against NumPy, and thinning within a range."""

import numpy as np
import pytest

from mapper.core.geometry import apply, exp
from mapper.core.linear import gram
from mapper.core.voxel_grid import thin, thin_in_range
from mapper.odometry.scans.scan_fit_kernels import count_showing, pair_rows

RNG = np.random.default_rng(7)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def towards(normals, others):
    return normals * np.sign(np.einsum("ni,ni->n", normals, others))[:, None]


@pytest.mark.parametrize("elsewhere", [0.0, 0.3, 1.0])
def test_rows_of_pairs_are_those_of_numpy(elsewhere):
    points, key_points = RNG.normal(size=(80, 3)), RNG.normal(size=(50, 3))
    normals, near_normals, key_normals = (unit(RNG.normal(size=(n, 3))) for n in (80, 80, 50))
    T = exp([0.1, -0.4, 0.2], [1.0, 2.0, -0.5])
    near, partners = np.arange(0, 80, 3), RNG.integers(0, 50, 80)

    rows, own_rows, distances = pair_rows(
        near,
        partners,
        points,
        apply(T, points),
        normals,
        near_normals,
        elsewhere,
        key_points,
        key_normals,
        T[:3, :3],
    )

    of_key = key_normals[partners[near]]
    n = of_key @ T[:3, :3]
    own = elsewhere * towards(normals[near], n) + (1.0 - elsewhere) * towards(near_normals[near], n)
    offsets = apply(T, points[near]) - key_points[partners[near]]
    assert distances == pytest.approx(np.einsum("ni,ni->n", of_key, offsets), abs=1e-12)
    assert rows == pytest.approx(np.hstack([np.cross(points[near], n), n]), abs=1e-12)
    assert own_rows == pytest.approx(np.hstack([np.cross(points[near], own), own]), abs=1e-12)


def test_a_motion_is_shown_by_the_pairs_that_face_it():
    points, agree = RNG.normal(size=(300, 3)), RNG.random(300) < 0.7
    n = unit(RNG.normal(size=(300, 3)))
    own = unit(n + 0.2 * RNG.normal(size=n.shape))
    rows, own_rows = (np.hstack([np.cross(points, normals), normals]) for normals in (n, own))
    motions = RNG.normal(size=(6, 6))

    showing = count_showing(motions, points, rows, own_rows, agree, 0.3)

    displacements = np.cross(motions[:, None, :3], points) + motions[:, None, 3:]
    shares = (motions @ rows.T) * (motions @ own_rows.T) / (displacements**2).sum(axis=2) * agree
    assert showing == pytest.approx(np.maximum((shares > 0.3).sum(axis=1), shares.sum(axis=1)), rel=1e-12)
    assert 0 < showing.min() < showing.max() < agree.sum()


def test_a_gram_matrix_is_that_of_numpy():
    A, B = RNG.normal(size=(100, 6)), RNG.normal(size=(100, 3))
    assert gram(A, B) == pytest.approx(A.T @ B, abs=1e-12)
    assert gram(A[:0], B[:0]).tolist() == np.zeros((6, 3)).tolist()


@pytest.mark.parametrize("voxel_m", [0.0, 1.5])
def test_points_in_range_are_thinned_as_without_the_others(voxel_m):
    points = RNG.uniform(-10.0, 10.0, (4000, 3)).astype(np.float32)
    origin = np.array([1.0, 0.0, 0.5], np.float32)
    kept, ranges_m = thin_in_range(points, origin, 3.0, 8.0, voxel_m)

    expected_m = np.linalg.norm(points - origin, axis=1)
    in_range = np.flatnonzero((expected_m >= 3.0) & (expected_m <= 8.0))
    assert np.array_equal(kept, in_range[thin(points[in_range], voxel_m)] if voxel_m else in_range)
    assert np.array_equal(ranges_m, expected_m[kept])
    assert len(kept) > 500
