"""The three refiners, and what a motion is said to be worth."""

import numpy as np
import pytest
import small_gicp

from mapper.core.geometry import apply, exp, inverse
from mapper.registration.pair_refinement import measured, refine, refined_motion
from mapper.registration.surfaces import prepared

VOXEL_M = 0.2
KINDS = ("icp", "plane-icp", "gicp")


def walls(rng, *, tilt_rad=0.0):
    """A floor and two walls at right angles, 8 m, tilted so that no normal lies along an axis."""
    u, v = rng.uniform(0.0, 8.0, (2, 20_000))
    zero = np.zeros_like(u)
    planes = [np.column_stack(c) for c in ((u, v, zero), (u, zero, v), (zero, u, v))]
    points = apply(exp(np.array([tilt_rad, 0.7 * tilt_rad, 0.0]), np.zeros(3)), np.concatenate(planes))
    return points.astype(np.float32)


def moved(points, T_target_source):
    return apply(inverse(T_target_source), points.astype(np.float64)).astype(np.float32)


MOTION = exp(np.array([0.02, -0.03, 0.05]), np.array([0.2, -0.15, 0.1]))


@pytest.mark.parametrize("kind", KINDS)
def test_a_known_motion_is_found_between_different_samples_of_the_same_walls(kind):
    rng = np.random.default_rng(1)
    target = prepared(walls(rng, tilt_rad=0.5), voxel_m=VOXEL_M)
    source = prepared(moved(walls(rng, tilt_rad=0.5), MOTION), voxel_m=VOXEL_M)

    found = refine(target, source, np.eye(4), kind=kind, pair_distances_m=(0.6,))

    miss = inverse(MOTION) @ found.T_target_source
    assert np.linalg.norm(miss[:3, 3]) < (0.03 if kind == "icp" else 0.003)
    assert found.inlier_ratio > 0.99
    assert found.inlier_rmse_m < VOXEL_M


def test_a_tenth_of_the_points_finds_the_same_motion():
    rng = np.random.default_rng(1)
    target = prepared(walls(rng, tilt_rad=0.5), voxel_m=VOXEL_M)
    source = prepared(moved(walls(rng, tilt_rad=0.5), MOTION), voxel_m=VOXEL_M)

    by_all, by_few = (
        refined_motion(
            target, source, np.eye(4), kind="plane-icp", pair_distances_m=(0.6,), max_points=max_points
        )
        for max_points in (None, len(source.points) // 10)
    )

    assert 0.0 < np.linalg.norm((inverse(by_all) @ by_few)[:3, 3]) < 0.005


def test_information_is_the_second_derivative_along_our_tangent():
    """Right perturbation, rotation before translation: checked against differences of the cost itself."""
    rng = np.random.default_rng(3)
    target = prepared(walls(rng, tilt_rad=0.4), voxel_m=VOXEL_M)
    T_target_source = exp(np.array([0.3, -0.2, 1.0]), np.array([5.0, -3.0, 2.0]))
    source = prepared(moved(walls(rng, tilt_rad=0.4), T_target_source), voxel_m=VOXEL_M)
    alignment = measured(target, source, T_target_source, max_pair_distance_m=0.5)
    partners, distances = target.nearest(apply(T_target_source, source.points))
    near = distances <= 0.5

    def cost(tangent):
        T = T_target_source @ exp(tangent[:3], tangent[3:])
        along = ((apply(T, source.points) - target.points[partners]) * target.normals[partners]).sum(axis=1)
        return 0.5 * (along[near] ** 2).sum()

    step = 1e-3
    axes = step * np.eye(6)
    hessian = np.array(
        [[cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b) for b in axes] for a in axes]
    ) / (4.0 * step**2)
    scale = alignment.information[3, 3] / hessian[3, 3]
    assert np.allclose(alignment.information, scale * hessian, atol=2e-3 * np.abs(scale * hessian).max())


def test_a_wall_does_not_see_the_motion_along_itself_by_any_kind():
    u, v = np.random.default_rng(4).uniform(0.0, 8.0, (2, 20_000))
    wall = np.column_stack([u, np.zeros_like(u), v]).astype(np.float32)
    cloud = prepared(wall, voxel_m=VOXEL_M)
    for kind in KINDS:
        found = refine(cloud, cloud, np.eye(4), kind=kind, pair_distances_m=(0.5,))
        along_x, along_y = found.information[3, 3], found.information[4, 4]
        assert along_x < 1e-6 * along_y


def test_too_few_points_and_clouds_apart_are_no_answer():
    cloud = prepared(walls(np.random.default_rng(5)), voxel_m=VOXEL_M)
    for few in (np.empty((0, 3), np.float32), np.zeros((1, 3), np.float32)):
        answer = refine(
            cloud, prepared(few, voxel_m=VOXEL_M), np.eye(4), kind="gicp", pair_distances_m=(1.0,)
        )
        assert not answer.converged
        assert f"{len(few)} points" in answer.reason
    apart = refine(cloud, cloud, exp(np.zeros(3), np.full(3, 50.0)), kind="gicp", pair_distances_m=(1.0,))
    assert not apart.converged
    assert "do not overlap" in apart.reason


@pytest.mark.parametrize("kind", ["icp", "gicp"])
def test_the_motion_is_the_one_that_small_gicp_finds(kind):
    rng = np.random.default_rng(6)
    target, source = walls(rng, tilt_rad=0.5), moved(walls(rng, tilt_rad=0.5), MOTION)
    found = refine(
        prepared(target, voxel_m=VOXEL_M),
        prepared(source, voxel_m=VOXEL_M),
        np.eye(4),
        kind=kind,
        pair_distances_m=(0.6,),
        max_iterations=100,
    )
    theirs, tree = small_gicp.preprocess_points(target, VOXEL_M, 10, 1)
    peer = small_gicp.align(
        theirs,
        small_gicp.preprocess_points(source, VOXEL_M, 10, 1)[0],
        tree,
        registration_type=kind.upper(),
        max_correspondence_distance=0.6,
        num_threads=1,
        max_iterations=100,
        rotation_epsilon=1e-5,
        translation_epsilon=1e-5,
    )
    assert np.abs(found.T_target_source - peer.T_target_source).max() < (5e-3 if kind == "icp" else 1e-3)
