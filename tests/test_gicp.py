"""The three refiners, and what a motion is said to be worth."""

import numpy as np
import pytest

from mapper.errors import DataError
from mapper.geometry import apply, exp, inverse
from mapper.registration.gicp import measured, prepared, refine

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

    found = refine(target, source, np.eye(4), kind=kind, max_pair_distance_m=0.6)

    miss = inverse(MOTION) @ found.T_target_source
    assert np.linalg.norm(miss[:3, 3]) < (0.03 if kind == "icp" else 0.003)
    assert found.inlier_ratio > 0.99
    assert found.inlier_rmse_m < VOXEL_M


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_clouds_give_the_same_bytes_and_stay_as_they_were(kind):
    rng = np.random.default_rng(2)
    cloud, other = walls(rng), moved(walls(rng), MOTION)
    before, guess = cloud.copy(), np.eye(4)

    answers = [
        refine(
            prepared(cloud, voxel_m=VOXEL_M),
            prepared(other, voxel_m=VOXEL_M),
            guess,
            kind=kind,
            max_pair_distance_m=0.6,
        )
        for _ in range(2)
    ]

    assert answers[0].T_target_source.tobytes() == answers[1].T_target_source.tobytes()
    assert answers[0].information.tobytes() == answers[1].information.tobytes()
    assert np.array_equal(cloud, before)
    assert np.array_equal(guess, np.eye(4))


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
        found = refine(cloud, cloud, np.eye(4), kind=kind, max_pair_distance_m=0.5)
        along_x, along_y = found.information[3, 3], found.information[4, 4]
        assert along_x < 1e-6 * along_y


def test_too_few_points_and_clouds_apart_are_no_answer():
    cloud = prepared(walls(np.random.default_rng(5)), voxel_m=VOXEL_M)
    for few in (np.empty((0, 3), np.float32), np.zeros((1, 3), np.float32)):
        answer = refine(
            cloud, prepared(few, voxel_m=VOXEL_M), np.eye(4), kind="gicp", max_pair_distance_m=1.0
        )
        assert not answer.converged
        assert f"{len(few)} points" in answer.reason
    apart = refine(cloud, cloud, exp(np.zeros(3), np.full(3, 50.0)), kind="gicp", max_pair_distance_m=1.0)
    assert not apart.converged
    assert "do not overlap" in apart.reason


def test_points_beyond_the_voxel_index_are_refused_rather_than_dropped():
    with pytest.raises(DataError, match=r"900000 m is beyond 209715 m"):
        prepared(np.full((30, 3), 9e5, np.float32), voxel_m=VOXEL_M)
