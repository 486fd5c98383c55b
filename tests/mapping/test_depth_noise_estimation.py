"""Depth noise measured on the planes of a log."""

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera, RgbdFrame, ray_table
from mapper.mapping.depth_noise_estimation import measure_noise
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig
from mapper.sensing.depth import depth_sigma_m
from tests.support.logs import log_in_memory, memory_entry

CAMERA = PinholeCamera(width_px=320, height_px=240, fx_px=260.0, fy_px=260.0, cx_px=159.5, cy_px=119.5)
GREY = np.zeros((240, 320), np.uint8)


def frame(k, depth_m):
    return RgbdFrame(k, GREY, depth_m.astype(np.float32), CAMERA)


def walls(noise, *, relief_m=0.0, frames=24):
    """Return a log of slanted walls, half of which, in stripes, has relief as of things on shelves."""
    rng, rays = np.random.default_rng(3), ray_table(CAMERA)
    entries = []
    for k in range(frames):
        depth_m = 1.0 / (1.0 / (1.0 + 0.5 * (k // 3)) + 0.05 * rays[..., 0] - 0.03 * rays[..., 1])
        relief = rng.standard_normal((120, 160)).repeat(2, axis=0).repeat(2, axis=1)
        depth_m += relief_m * relief * (np.arange(320) % 80 < 40)
        depth_m += depth_sigma_m(noise, depth_m) * rng.standard_normal(depth_m.shape)
        entries.append(memory_entry(k, frame(k, depth_m)))
    entries.append(memory_entry(frames, FrameError("damaged")))
    return log_in_memory(entries)


@pytest.mark.parametrize("relief_m", [0.0, 0.03])
@pytest.mark.parametrize(
    "noise", [DepthNoiseConfig(quadratic_per_m=0.006), KINECT_NOISE], ids=lambda noise: noise.text
)
def test_the_noise_is_found_beside_relief(noise, relief_m):
    measured = measure_noise(walls(noise, relief_m=relief_m), workers=1)
    far_m = np.array([3.5, 4.5, 6.0])
    np.testing.assert_allclose(depth_sigma_m(measured.noise, far_m), depth_sigma_m(noise, far_m), rtol=0.15)
    assert measured.detail.startswith("measured on planes")
    assert measured.share_within(2.0) == pytest.approx(0.3, abs=0.08)


def test_noise_that_is_the_same_at_all_distances_is_not_taken_for_less():
    noise = DepthNoiseConfig(constant_m=0.005)
    measured = measure_noise(walls(noise), workers=1)
    assert (depth_sigma_m(measured.noise, np.array([4.5, 10.0])) > 0.005).all()


def test_exact_depth_counts_everywhere():
    exact = DepthNoiseConfig(constant_m=1e-9)
    assert depth_sigma_m(measure_noise(walls(exact), workers=1).noise, np.array([50.0]))[0] < 0.01


def test_the_number_of_threads_changes_nothing():
    source = walls(KINECT_NOISE)
    assert measure_noise(source, workers=0).noise == measure_noise(source, workers=3).noise


def test_without_planes_it_is_a_kinect_s():
    rng = np.random.default_rng(0)
    clutter = [memory_entry(k, frame(k, rng.uniform(0.5, 4.0, (240, 320)))) for k in range(4)]
    for entries in (clutter, [memory_entry(0, FrameError("damaged"))]):
        measured = measure_noise(log_in_memory(entries), workers=1)
        assert measured.noise == KINECT_NOISE
        assert "too few planes" in measured.detail


def test_what_is_given_is_not_measured():
    given = DepthNoiseConfig(quadratic_per_m=0.1)
    measured = measure_noise(walls(KINECT_NOISE), given=given, workers=1)
    assert (measured.noise, measured.detail) == (given, "as set")
