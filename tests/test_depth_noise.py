"""A sensor's depth noise in the configuration, and what odometry and loops make of it."""

import numpy as np
import pytest
from view_world import Room

from mapper.config import load_config
from mapper.config.depth_noise import DepthNoiseConfig
from mapper.config.loops import VerificationConfig
from mapper.config.odometry import LocalMapConfig
from mapper.config.synthetic import SynthConfig
from mapper.errors import ConfigError
from mapper.geometry import exp
from mapper.loops.verification import ImageVerifier
from mapper.sensing.depth_noise import pixel_weights
from mapper.sources.synthetic.source import SyntheticSource

NOISE = DepthNoiseConfig(constant_m=0.002, linear=-0.001, quadratic_per_m=0.003)
DEPTH_M = np.array([0.5, 1.0, 2.0, np.nan])
SIGMA_PX = np.array([1.0, 1.2, 1.44, 1.0])


def weights(depth_noise):
    return pixel_weights(
        SIGMA_PX, DEPTH_M, virtual_baseline_px_m=40.0, disparity_sigma_px=0.5, depth_noise=depth_noise
    )


def test_the_model_is_a_parabola():
    np.testing.assert_allclose(NOISE.sigma_m(np.array([0.5, 2.0])), [0.00225, 0.012])


def test_a_known_noise_weighs_the_disparity_and_nothing_else():
    usual, known = weights(None), weights(NOISE)
    np.testing.assert_array_equal(usual, np.column_stack([SIGMA_PX, SIGMA_PX, 0.5 * SIGMA_PX]) ** -2.0)
    np.testing.assert_array_equal(known[:, :2], usual[:, :2])
    sigma_px = 40.0 / np.array([0.25, 1.0, 4.0]) * [0.00225, 0.004, 0.012]
    np.testing.assert_allclose(known[:3, 2], sigma_px**-2.0)
    assert known[3, 2] == usual[3, 2], "without depth a weight is never used, but must be finite"


def test_the_disparity_form_is_the_same_at_every_depth():
    sigma_disparity_px = 0.08
    noise = DepthNoiseConfig(quadratic_per_m=sigma_disparity_px / 40.0)
    np.testing.assert_allclose(weights(noise)[:3, 2], sigma_disparity_px**-2.0)


@pytest.mark.parametrize(
    "text",
    [
        "odometry.depth_noise.linear=-0.1",
        "odometry.depth_noise.constant_m=0",
        "loops.verification.depth_noise.linear=0",
    ],
)
def test_noise_that_vanishes_at_some_depth_is_refused(text):
    with pytest.raises(ConfigError, match=r"depth_noise: .*is not > 0 at every depth"):
        load_config(None, [text])


def test_a_noise_that_touches_zero_is_refused_and_one_just_above_is_not():
    with pytest.raises(ValueError, match="not > 0"):
        DepthNoiseConfig(constant_m=0.01, linear=-0.02, quadratic_per_m=0.01)
    DepthNoiseConfig(constant_m=0.01, linear=-0.0199, quadratic_per_m=0.01)


def test_the_odometry_weighs_by_it():
    frame = next(
        SyntheticSource(SynthConfig(width_px=320, height_px=240, texture_px_per_m=96)).entries()
    ).load()
    seen = {
        name: LocalMapConfig(depth_noise=noise).build()
        for name, noise in {"usual": None, "known": NOISE}.items()
    }
    usual, known = (odometry.observe(frame) for odometry in seen.values())
    depth_m = known.points_camera[:, 2]
    near = ~np.isnan(depth_m)
    assert near.sum() > 100
    np.testing.assert_allclose(
        known.weights[near, 2] ** -0.5, 40.0 / depth_m[near] ** 2 * NOISE.sigma_m(depth_m[near])
    )
    np.testing.assert_array_equal(usual.weights[:, 2], usual.weights[:, 1])
    np.testing.assert_array_equal(usual.measured, known.measured)


def test_a_loop_is_told_more_surely_by_a_better_sensor():
    sigmas_m = []
    for noise in (DepthNoiseConfig(constant_m=0.002), None, DepthNoiseConfig(constant_m=0.5)):
        room = Room(1)  # a room draws anew with every view
        views = room.view(np.eye(4), 0), room.view(exp(np.zeros(3), np.array([0.1, 0.0, 0.0])), 1)
        found = ImageVerifier(VerificationConfig(depth_noise=noise)).verify(*views)
        assert found.reason == ""
        sigmas_m.append(np.linalg.inv(found.information)[3, 3] ** 0.5)
    good, usual, bad = sigmas_m
    assert good < usual < bad
