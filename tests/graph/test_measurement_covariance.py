import numpy as np
import pytest

from mapper.core.geometry import exp, transform
from mapper.graph.measurement_covariance import compare, with_model_error
from tests.support.planar import at

NOTHING = np.zeros((6, 6))


def shifted(x_m: float, yaw_rad: float = 0.0) -> np.ndarray:
    T = exp(np.array([0.0, 0.0, yaw_rad]), np.zeros(3))
    T[0, 3] = x_m
    return T


def test_without_uncertainty_the_slack_is_the_limit():
    for miss_m, is_possible in ((0.99, True), (1.01, False)):
        apart = compare(shifted(miss_m), np.eye(4), NOTHING, slack_m=1.0, slack_rad=0.1)
        assert apart.is_possible is is_possible
        assert apart.allowed_m == pytest.approx(1.0)
        assert apart.allowed_rad == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("miss", "variance_m2", "slack_m", "is_possible"),
    [
        (shifted(0.9), 0.0, 1.0, True),
        (shifted(0.0, 0.09), 0.0, 1.0, True),
        (shifted(0.9, 0.09), 0.0, 1.0, False),  # both parts count together
        (shifted(4.0), 1.0, 0.1, True),
        (transform(np.eye(3), [0.0, 4.0, 0.0]), 1.0, 0.1, False),  # uncertainty counts in its own direction
    ],
)
def test_a_miss_is_possible_within_slack_and_uncertainty(miss, variance_m2, slack_m, is_possible):
    covariance = np.diag([0.0, 0.0, 0.0, variance_m2, 0.0, 0.0])
    assert compare(miss, np.eye(4), covariance, slack_m=slack_m, slack_rad=0.1).is_possible is is_possible


def test_honest_measurements_pass_but_for_one_in_a_thousand():
    rng = np.random.default_rng(0)
    root = np.diag([0.02] * 3 + [0.1] * 3)
    possible = 0
    for _ in range(5000):
        twist = root @ rng.standard_normal(6)
        T = exp(twist[:3], twist[3:])
        possible += compare(T, np.eye(4), root @ root, slack_m=1e-9, slack_rad=1e-9).is_possible
    assert 0.998 <= possible / 5000 < 1.0


def test_model_errors_grow_with_the_distance_between_the_views():
    tight = np.eye(6) * 1e8
    near, far = with_model_error(tight, at(0.1)), with_model_error(tight, at(2.0))
    assert np.linalg.inv(far)[3, 3] ** 0.5 == pytest.approx(0.041, rel=0.01)
    assert np.linalg.inv(near)[3, 3] < np.linalg.inv(far)[3, 3]
    loose = np.eye(6)
    np.testing.assert_allclose(with_model_error(loose, at(0.1)), loose, rtol=1e-3)
