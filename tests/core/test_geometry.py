import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapper.core import geometry as g
from mapper.core.errors import DataError
from mapper.core.geometry import stride_for

COORDINATE = st.floats(-10.0, 10.0)
VECTORS = st.tuples(COORDINATE, COORDINATE, COORDINATE).map(np.array)
AXES = VECTORS.filter(lambda v: np.linalg.norm(v) > 1e-2).map(lambda v: v / np.linalg.norm(v))
ANGLES = st.one_of(
    st.floats(0.0, 3.14),
    st.sampled_from([1e-9, 9e-8, 2e-7, 5e-7, 1e-6, 1e-4, np.pi - 1e-4, np.pi - 1e-6, np.pi - 2e-7, np.pi]),
)
ROTATION_VECTORS = st.builds(lambda axis, angle: axis * angle, AXES, ANGLES)
MOTIONS = st.builds(g.exp, ROTATION_VECTORS, VECTORS)


@given(MOTIONS, MOTIONS, VECTORS)
def test_inner_names_cancel(T_a_b, T_b_c, point_c):
    T_a_c = T_a_b @ T_b_c
    through_b = g.apply(T_a_b, g.apply(T_b_c, point_c[None]))
    np.testing.assert_allclose(g.apply(T_a_c, point_c[None]), through_b, atol=1e-12)
    np.testing.assert_allclose(g.inverse(T_a_b) @ T_a_c, T_b_c, atol=1e-12)


@given(VECTORS, VECTORS)
def test_skew_is_the_cross_product(v, w):
    np.testing.assert_allclose(g.skew(v) @ w, np.cross(v, w), atol=1e-12)


@given(ROTATION_VECTORS)
def test_rotation_log_undoes_exp(rotation_rad):
    R = g.rotation_exp(rotation_rad)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    found = g.rotation_log(R)
    if np.linalg.norm(rotation_rad) > np.pi - 1e-6 and found @ rotation_rad < 0.0:
        found = -found  # a half turn either way round is the same
    np.testing.assert_allclose(found, rotation_rad, rtol=1e-8, atol=1e-9)


@given(ROTATION_VECTORS, VECTORS)
def test_log_undoes_exp(rotation_rad, translation_m):
    T = g.exp(rotation_rad, translation_m)
    np.testing.assert_allclose(g.exp(*g.log(T)), T, atol=1e-7)


@given(ROTATION_VECTORS, VECTORS)
def test_exp_is_the_sum_of_its_series(rotation_rad, translation_m):
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = g.skew(rotation_rad), translation_m
    total, term = np.eye(4), np.eye(4)
    for n in range(1, 40):
        term = term @ twist / n
        total = total + term
    np.testing.assert_allclose(g.exp(rotation_rad, translation_m), total, atol=1e-11)


@given(MOTIONS, ROTATION_VECTORS, VECTORS)
def test_adjoint_carries_twists_between_frames(T_a_b, rotation_rad, translation_m):
    twist_a = g.adjoint(T_a_b) @ np.concatenate([rotation_rad, translation_m])
    moved = g.exp(twist_a[:3], twist_a[3:])
    np.testing.assert_allclose(moved @ T_a_b, T_a_b @ g.exp(rotation_rad, translation_m), atol=1e-9)


@given(MOTIONS, MOTIONS)
def test_interpolation_starts_and_ends_where_it_should(T_a_b, T_a_c):
    np.testing.assert_allclose(g.interpolate(T_a_b, T_a_c, 0.0), T_a_b, atol=1e-12)
    np.testing.assert_allclose(g.interpolate(T_a_b, T_a_c, 1.0), T_a_c, atol=1e-7)


def test_interpolation_is_even():
    T_a_c = g.transform(g.rotation_exp(np.array([0.0, 0.0, 1.2])), np.array([4.0, 0.0, -2.0]))
    half = g.interpolate(np.eye(4), T_a_c, 0.25)
    np.testing.assert_allclose(g.rotation_log(half[:3, :3]), [0, 0, 0.3], atol=1e-15)
    np.testing.assert_allclose(half[:3, 3], [1.0, 0.0, -0.5])


@given(ROTATION_VECTORS, ROTATION_VECTORS)
def test_the_angle_between_rotations_is_symmetric_and_ignores_the_frame(a, b):
    R_a, R_b = g.rotation_exp(a), g.rotation_exp(b)
    assert g.angle_between(R_a, R_b) == pytest.approx(g.angle_between(R_b, R_a), abs=1e-9)
    assert g.angle_between(np.eye(3), R_a) == pytest.approx(np.linalg.norm(a), abs=1e-9)


@given(ROTATION_VECTORS, st.integers(0, 2**32 - 1))
def test_the_nearest_rotation_is_no_farther_than_the_one_it_was_made_from(rotation_rad, seed):
    R = g.rotation_exp(rotation_rad)
    M = R + 0.1 * np.random.default_rng(seed).standard_normal((3, 3))
    nearest = g.nearest_rotation(M)
    assert np.linalg.det(nearest) == pytest.approx(1.0)
    assert np.linalg.norm(nearest - M) <= np.linalg.norm(R - M) + 1e-12
    np.testing.assert_allclose(g.nearest_rotation(R), R, atol=1e-12)


def test_the_nearest_rotation_of_a_reflection_is_a_rotation():
    R = g.nearest_rotation(np.diag([1.0, 1.0, -0.5]))
    np.testing.assert_allclose(R, np.eye(3), atol=1e-12)


def test_the_mean_rotation_lies_in_the_middle_and_heeds_weights():
    turns = [g.rotation_exp(np.array([0.0, 0.0, a])) for a in (0.1, 0.5)]
    np.testing.assert_allclose(g.rotation_log(g.mean_rotation(turns, [1.0, 1.0])), [0, 0, 0.3], atol=1e-12)
    np.testing.assert_allclose(g.mean_rotation(turns, [0.0, 2.0]), turns[1], atol=1e-12)


@settings(max_examples=50)
@given(MOTIONS, st.floats(0.1, 10.0), st.integers(3, 30), st.integers(0, 2**32 - 1))
def test_fit_rigid_recovers_motion_and_scale(T_target_source, scale, n, seed):
    source = np.random.default_rng(seed).uniform(-2, 2, (n, 3))
    T_found, one = g.fit_rigid(g.apply(T_target_source, source), source)
    assert one == 1.0
    np.testing.assert_allclose(T_found, T_target_source, atol=1e-6)
    target = scale * source @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    T_found, found_scale = g.fit_rigid(target, source, with_scale=True)
    assert found_scale == pytest.approx(scale)
    np.testing.assert_allclose(T_found, T_target_source, atol=1e-5)


def test_fit_rigid_of_noisy_planar_points_is_never_a_reflection():
    rng = np.random.default_rng(0)
    for _ in range(200):
        source = np.column_stack([rng.uniform(-1, 1, (4, 2)), np.zeros(4)])
        T, _ = g.fit_rigid(source + 0.5 * rng.standard_normal((4, 3)), source)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_fit_rigid_is_the_least_squares_optimum():
    rng = np.random.default_rng(1)
    source = rng.standard_normal((20, 3))
    target = source + 0.2 * rng.standard_normal((20, 3))
    T, _ = g.fit_rigid(target, source)

    def cost(T_any):
        return ((g.apply(T_any, source) - target) ** 2).sum()

    for _ in range(50):
        nudge = g.exp(0.01 * rng.standard_normal(3), 0.01 * rng.standard_normal(3))
        assert cost(nudge @ T) > cost(T)


def test_fit_rigid_refuses_too_few_unequal_or_coinciding_points():
    points = np.zeros((3, 3))
    with pytest.raises(DataError, match=r"got \(2, 3\) and \(2, 3\), want two \(N, 3\) with N ≥ 3"):
        g.fit_rigid(points[:2], points[:2])
    with pytest.raises(DataError, match=r"got \(3, 3\) and \(2, 3\)"):
        g.fit_rigid(points, points[:2])
    with pytest.raises(DataError, match="all source points coincide"):
        g.fit_rigid(points, points, with_scale=True)


def test_is_rigid_refuses_matrices_that_only_resemble_a_motion():
    T = g.exp(np.array([0.3, -0.2, 0.9]), np.array([1.0, 2.0, 3.0]))
    assert g.is_rigid(T)
    assert g.is_rigid(np.stack([T, np.eye(4)]))
    scaled, mirrored, bent, broken, far, huge = (T.copy() for _ in range(6))
    scaled[:3, :3] *= 1.001
    mirrored[:3, 0] *= -1.0
    bent[3, 0] = 0.1
    broken[0, 3] = np.nan
    far[0, 3] = -1e12
    huge[0, 0] = 1e200
    bad_pairs = [np.stack([T, bad]) for bad in (scaled, far, huge)]
    for bad in (scaled, mirrored, bent, broken, far, huge, np.eye(3), *bad_pairs):
        assert not g.is_rigid(bad)


@pytest.mark.parametrize("count", [0, 1, 9, 10, 11, 20, 21])
def test_the_smallest_step_that_leaves_few_enough(count):
    step = stride_for(count, 10)
    assert len(range(0, count, step)) <= 10
    assert step == 1 or len(range(0, count, step - 1)) > 10
