"""Corners of outlines: a pixel may show the depth of what is behind."""

import cv2
import numpy as np

from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry

CAMERA = PinholeCamera(320, 240, 300.0, 300.0, 160.0, 120.0)


def boards_before_a_wall(near_m):
    """Return what is seen of boards without texture, dark ones, before a plain wall 3 m away."""
    rng = np.random.default_rng(3)
    image, depth_m = np.full((240, 320), 170, np.uint8), np.full((240, 320), 3.0, np.float32)
    for left in range(30, 280, 40):
        for top in range(30, 200, 45):
            right, bottom = left + int(rng.integers(14, 26)), top + int(rng.integers(14, 26))
            cv2.rectangle(image, (left, top), (right, bottom), int(rng.uniform(20, 110)), cv2.FILLED)
            cv2.rectangle(depth_m, (left + 1, top + 1), (right - 1, bottom - 1), near_m, cv2.FILLED)
    return RgbdFrame(0, image[:, :, np.newaxis].repeat(3, 2), depth_m, CAMERA)


def test_disparities_behind_an_outline_have_a_hundredth_of_the_weight_in_bundle_adjustments():
    odometry = build_frame_odometry(LocalMapConfig())
    observation = odometry.observe(boards_before_a_wall(2.0))

    weights = observation.with_disparity_sigma(0.5).weights

    relative = weights[:, 2] / weights[:, 0]
    is_behind = observation.has_depth & (observation.depth_m > 2.5)
    assert 20 < is_behind.sum() < len(observation) - 20
    np.testing.assert_allclose(relative[is_behind], 0.04)
    np.testing.assert_allclose(relative[~is_behind], 4.0)
    np.testing.assert_array_equal(weights[:, :2], observation.weights[:, :2])


def test_boards_that_hang_on_the_wall_have_no_outline_in_depth():
    observation = build_frame_odometry(LocalMapConfig()).observe(boards_before_a_wall(2.9))

    assert len(observation) > 50
    assert not observation.on_outline.any()
