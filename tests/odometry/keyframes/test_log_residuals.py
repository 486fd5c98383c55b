"""Information of poses by what a log's residuals show."""

import numpy as np

from mapper.core.geometry import transform
from mapper.graph.measurement_covariance import with_model_error
from mapper.odometry.keyframes.local_mapping import LogResiduals
from mapper.registration.reprojection import ResidualStatistics

INFORMATION = np.diag([1e7] * 3 + [1e6] * 3)
T_I_J = transform(np.eye(3), np.array([0.5, 0.0, 0.0]))


def honest(*statistics):
    residuals = LogResiduals()
    for one in statistics:
        residuals.add(one)
    return residuals.rescale(INFORMATION, T_I_J)


def sigma_m(information):
    return np.linalg.inv(information)[3, 3] ** 0.5


def test_of_few_keyframes_nothing_is_taken_for_granted():
    assert np.allclose(honest(*[ResidualStatistics(0.1, 0.9)] * 4), with_model_error(INFORMATION, T_I_J))


def test_independent_residuals_leave_an_eighth_of_the_model_error():
    found = honest(*[ResidualStatistics(0.25, 0.9)] * 9)
    assert np.isclose(sigma_m(found), np.hypot(0.5e-3, 0.125 * (1e-3 + 0.02 * 0.5)))


def test_residuals_that_depend_on_each_other_show_all_of_it():
    found = honest(*[ResidualStatistics(1.0, 2.0)] * 9)
    assert np.isclose(sigma_m(found), np.hypot(2.0**0.5 * 1e-3, 1e-3 + 0.02 * 0.5))


def test_single_keyframes_do_not_decide():
    usual = [ResidualStatistics(0.25, 0.9)] * 9
    assert np.allclose(honest(*usual), honest(*usual, ResidualStatistics(50.0, 9.0)))
