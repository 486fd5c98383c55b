"""Correlation of planar scans: without a guess, and near one."""

import numpy as np
import pytest

from mapper.core.geometry import apply, inverse, planar_motion
from mapper.registration.correlation import LikelihoodField, correlate
from mapper.registration.pair_refinement import refine
from mapper.registration.surfaces import prepared

CORNERS = np.array([[-4.0, -3.0], [5.0, -3.0], [5.0, 1.0], [2.0, 1.0], [2.0, 4.0], [-4.0, 4.0]])


def room(sigma_m: float = 0.005, seed: int = 0) -> np.ndarray:
    """Points on the walls of a room without a symmetry, 4 cm apart."""
    points = []
    for begin, end in zip(CORNERS, np.roll(CORNERS, -1, axis=0), strict=True):
        steps = np.arange(0.0, 1.0, 0.04 / np.linalg.norm(end - begin))
        points.append(begin + steps[:, None] * (end - begin))
    noisy = np.vstack(points) + np.random.default_rng(seed).normal(0.0, sigma_m, (sum(map(len, points)), 2))
    return np.column_stack([noisy, np.zeros(len(noisy))])


def moved_by(T):
    """The same walls, scanned from another pose."""
    return apply(inverse(T), room(seed=1))


@pytest.mark.parametrize("yaw_rad", [-3.0, -1.5, 0.0, 0.8, 2.2])
def test_finds_a_motion_in_any_heading(yaw_rad):
    T = planar_motion(1.3, -0.7, yaw_rad)

    (support, found), *others = correlate(
        room(), moved_by(T), reach_m=3.0, cell_m=0.2, peaks=3, apart_m=0.5, apart_rad=0.3
    )

    miss = inverse(found) @ T
    assert support > 0.8
    assert np.linalg.norm(miss[:2, 3]) < 0.3
    assert abs(np.arctan2(miss[1, 0], miss[0, 0])) < 0.05
    assert all(other < support for other, _ in others)


def test_without_points_no_motion_is_found():
    assert (
        correlate(np.empty((0, 3)), room(), reach_m=1.0, cell_m=0.2, peaks=1, apart_m=0.5, apart_rad=0.3)
        == []
    )


def test_field_leads_to_where_icp_converges():
    T = planar_motion(0.4, 0.2, 0.3)
    guess = T @ planar_motion(0.1, -0.12, 0.05)
    source = prepared(moved_by(T), voxel_m=0.1, is_planar=True)

    near = LikelihoodField.of(room(), 0.05).best_near(source.points, guess, reach_m=0.15, reach_rad=0.06)

    miss = inverse(near) @ T
    assert np.linalg.norm(miss[:2, 3]) < 0.06
    target = prepared(room(), voxel_m=0.1, is_planar=True)
    found = refine(target, source, near, kind="gicp", pair_distances_m=(0.3, 0.15))
    miss = inverse(found.T_target_source) @ T
    assert np.linalg.norm(miss[:2, 3]) < 0.004
    assert abs(np.arctan2(miss[1, 0], miss[0, 0])) < 0.001


def test_refined_motions_stay_in_the_plane():
    target = prepared(room(), voxel_m=0.1, is_planar=True)
    source = prepared(moved_by(planar_motion(0.1, 0.05, 0.02)), voxel_m=0.1, is_planar=True)

    found = refine(target, source, np.eye(4), kind="gicp", pair_distances_m=(0.5, 0.2)).T_target_source

    assert found[2].tolist() == [0.0, 0.0, 1.0, 0.0]
    assert found[:2, 2].tolist() == [0.0, 0.0]


def test_normals_of_a_plane_lie_in_it_and_corners_have_none():
    cloud = prepared(room(sigma_m=0.0), voxel_m=0.1, is_planar=True)
    has_normal = cloud.normals.any(axis=1)
    to_corner_m = np.linalg.norm(cloud.points[:, None, :2] - CORNERS, axis=2).min(axis=1)

    assert not cloud.normals[:, 2].any()
    assert has_normal[to_corner_m > 0.3].all()
    assert np.abs(cloud.normals[to_corner_m > 0.3]).max(axis=1) == pytest.approx(1.0, abs=1e-6)
    assert not has_normal[to_corner_m < 0.05].any()
