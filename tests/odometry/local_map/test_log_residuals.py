"""Information of poses by what a log's residuals show."""

import numpy as np

from mapper.core.geometry import transform
from mapper.graph.noise import with_model_error
from mapper.odometry.local_map.bundle.log_residuals import USUAL_VARIANCE, LogResiduals
from mapper.registration.variance_factor import ResidualStatistics

INFORMATION = np.diag([1e7] * 3 + [1e6] * 3)
T_I_J = transform(np.eye(3), np.array([0.5, 0.0, 0.0]))


def rescaled(*statistics):
    residuals = LogResiduals()
    for one in statistics:
        residuals.add(one)
    return residuals.rescaled(INFORMATION, T_I_J)


def sigma_m(information):
    return np.linalg.inv(information)[3, 3] ** 0.5


def test_of_few_keyframes_nothing_is_taken_for_granted():
    assert np.allclose(rescaled(*[ResidualStatistics(0.1, 0.9)] * 4), with_model_error(INFORMATION, T_I_J))


def test_independent_residuals_leave_an_eighth_of_the_model_error():
    found = rescaled(*[ResidualStatistics(0.25, 0.9)] * 9)
    assert np.isclose(sigma_m(found), np.hypot(0.5e-3, 0.125 * (1e-3 + 0.02 * 0.5)))


def test_residuals_that_depend_on_each_other_show_all_of_it():
    found = rescaled(*[ResidualStatistics(1.0, 2.0)] * 9)
    assert np.isclose(sigma_m(found), np.hypot(2.0**0.5 * 1e-3, 1e-3 + 0.02 * 0.5))


def test_single_keyframes_do_not_decide():
    usual = [ResidualStatistics(0.25, 0.9)] * 9
    assert np.allclose(rescaled(*usual), rescaled(*usual, ResidualStatistics(50.0, 9.0)))


def test_the_variance_of_features_is_the_usual_one_within_limits():
    def variance(*values):
        residuals = LogResiduals()
        for value in values:
            residuals.add(ResidualStatistics(value, 1.0))
        return residuals.variance

    assert variance(*[0.5] * 4) == USUAL_VARIANCE
    assert variance(*[0.3] * 8, 50.0) == 0.3
    assert variance(*[0.01] * 9) == 0.15
    assert variance(*[4.0] * 9) == 1.0


def test_the_variance_factor_counts_what_neighbours_share_within_limits():
    def factor(*statistics):
        residuals = LogResiduals()
        for one in statistics:
            residuals.add(one)
        return residuals.variance_factor

    assert factor(*[ResidualStatistics(0.2, 2.0)] * 4) == USUAL_VARIANCE
    assert factor(*[ResidualStatistics(0.2, 2.0)] * 8, ResidualStatistics(50.0, 9.0)) == 0.4
    assert factor(*[ResidualStatistics(0.01, 0.9)] * 9) == 0.05
    assert factor(*[ResidualStatistics(0.9, 2.0)] * 9) == 1.0


def disparity_sigma(*ratios, most=1.0):
    residuals = LogResiduals(disparity_sigma=most)
    for ratio in ratios:
        residuals.add_disparity_ratio(ratio)
    return residuals.disparity_sigma


def test_disparities_are_as_uncertain_as_most_keyframes_show():
    assert disparity_sigma() == 1.0
    assert disparity_sigma(*[0.25] * 4) == 1.0
    assert disparity_sigma(*[0.25] * 8, 9.0) == 0.5


def test_disparities_have_limits_within_which_residuals_decide():
    assert disparity_sigma(*[9.0] * 20) == 1.0
    assert disparity_sigma(*[1e-4] * 20) == 1.0 / 3.0
    assert disparity_sigma(*[0.16] * 20, most=0.2) == 0.2
