"""Depth noise of a sensor in the settings, and its effect on the odometry."""

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import ConfigError
from mapper.core.frames import RgbdFrame
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.sensing.config import DepthNoiseConfig
from mapper.sensing.depth_noise import depth_sigma_m, feature_depth_sigma_m
from mapper.simulation.config import SynthConfig
from mapper.simulation.source import CameraSimulator

NOISE = DepthNoiseConfig(constant_m=0.002, linear=-0.001, quadratic_per_m=0.003)
TINY = DepthNoiseConfig(constant_m=1e-9)


def test_the_model_is_a_parabola_and_can_be_read():
    np.testing.assert_allclose(depth_sigma_m(NOISE, np.array([0.5, 2.0])), [0.00225, 0.012])
    assert NOISE.text == "0.002 − 0.001·z + 0.003·z²"
    assert DepthNoiseConfig(quadratic_per_m=0.0019).text == "0.0019·z²"


@pytest.mark.parametrize("text", ["linear=-0.1", "constant_m=0"])
def test_noise_that_vanishes_at_some_depth_is_refused(text):
    with pytest.raises(ConfigError, match=r"depth_noise: .*is not > 0 at every depth"):
        load_config(None, [f"odometry.depth_noise.{text}"])


def test_a_noise_that_touches_zero_is_refused_and_one_just_above_is_not():
    with pytest.raises(ValueError, match="not > 0"):
        DepthNoiseConfig(constant_m=0.01, linear=-0.02, quadratic_per_m=0.01)
    DepthNoiseConfig(constant_m=0.01, linear=-0.0199, quadratic_per_m=0.01)


def sigmas_m(depth_m, pixels, sigma_px, noise):
    columns, rows = np.array(pixels).T
    return feature_depth_sigma_m(
        depth_m.astype(np.float32), columns, rows, sigma_px=np.array(sigma_px), noise=noise
    )


def test_on_a_wall_across_the_axis_there_is_only_noise():
    wall_m = np.full((20, 30), 2.0)
    wall_m[3, 6] = 0.0
    found = sigmas_m(wall_m, [(5, 3), (29, 19), (0, 0)], [1.0, 2.4, 3.0], NOISE)
    np.testing.assert_allclose(found, 0.012, rtol=1e-6)


def test_a_slope_counts_by_how_uncertain_the_pixel_is():
    columns, rows = np.meshgrid(np.arange(40), np.arange(30))
    slope_m = 1.0 + 0.003 * columns + 0.004 * rows
    found = sigmas_m(slope_m, [(20, 15)] * 3, [1.0, 1.44, 3.0], TINY)
    np.testing.assert_allclose(found, 0.005 * np.array([1.0, 1.44, 3.0]), rtol=1e-4)
    with_noise = sigmas_m(np.full((30, 40), 2.0) + 0.005 * columns, [(20, 15)], [1.0], NOISE)
    np.testing.assert_allclose(with_noise, np.hypot(depth_sigma_m(NOISE, np.array([2.1])), 0.005), rtol=1e-4)


def test_beside_an_edge_the_depth_is_uncertain():
    edge_m = np.full((20, 30), 1.0)
    edge_m[:, 15:] = 3.0
    beside, away = sigmas_m(edge_m, [(14, 10), (5, 10)], [1.0, 1.0], NOISE)
    assert beside > 0.4
    assert away == pytest.approx(0.004)


def test_the_odometry_weighs_by_it_and_by_nothing_without_it():
    frame = next(
        CameraSimulator(SynthConfig(width_px=320, height_px=240, texture_px_per_m=96)).log().entries()
    ).load()
    wall_m = np.full_like(frame.depth_m, 2.0)
    wall_m[:120] = 0.0
    frame = RgbdFrame(frame.stamp_ns, frame.image, wall_m, frame.camera)
    usual, known = (
        build_frame_odometry(LocalMapConfig(depth_noise=noise, disparity_sigma_px=0.5)).observe(frame)
        for noise in (None, NOISE)
    )
    np.testing.assert_allclose(usual.weights[:, 2] ** -0.5, 0.5 * usual.weights[:, 0] ** -0.5)
    np.testing.assert_array_equal(known.weights[:, :2], usual.weights[:, :2])
    np.testing.assert_array_equal(known.measured, usual.measured)
    near = known.has_depth
    assert 100 < near.sum() < len(known)
    np.testing.assert_allclose(known.weights[near, 2] ** -0.5, 40.0 / 4.0 * 0.012, rtol=1e-6)
    np.testing.assert_array_equal(known.weights[~near, 2], usual.weights[~near, 2])
