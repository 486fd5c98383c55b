"""Features of unknown depth show how the camera turned, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, log
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.observation.readout_time import ReadoutTime
from mapper.odometry.local_map.pose.far_features import turned_by_far_features
from mapper.odometry.local_map.pose.local_search import LocalSearch
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose, unmatched

CONFIG = LocalMapConfig()
SHIFT_PX = 8


@pytest.fixture
def observed(frames):
    """Return what is observed in the first frame, its columns shifted, with depth in its lowest rows only."""

    def observe(shift_px: int, *, first_row: int):
        frame = frames[0]
        depth_m = np.where(frame.depth_m > 0.0, frame.depth_m, np.float32(2.0))
        depth_m[:first_row] = 0.0
        depth_m = np.roll(depth_m, shift_px, axis=1)
        return build_frame_odometry(CONFIG).observe(
            replace(frame, image=np.roll(frame.image, shift_px, axis=1), depth_m=depth_m)
        )

    return observe


def turned(observation, before, T_predicted):
    """Return the pose of an observation after one at the origin."""
    readout = ReadoutTime(0.0, windows_sharing=CONFIG.bundle_keyframes)
    search = LocalSearch(CONFIG, LandmarkMap(scale_factor=1.2, readout=readout))
    last = TrackedPose(before, np.eye(4), unmatched(before), 0, 0, 1.0, 0, 0.0, "map")
    return turned_by_far_features(search, observation, last, T_predicted, sigma_m=0.01)


def test_a_turn_that_was_not_predicted(observed):
    before, observation = observed(0, first_row=200), observed(SHIFT_PX, first_row=200)
    T_predicted = exp(np.zeros(3), np.array([0.0, 0.0, -0.05]))
    found = turned(observation, before, T_predicted)
    rotation_rad = log(found)[0]
    assert rotation_rad[1] == pytest.approx(SHIFT_PX / observation.intrinsics[0], rel=0.15)
    assert np.abs(rotation_rad[[0, 2]]).max() < 0.003
    np.testing.assert_allclose(inverse(found)[:3, 3], inverse(T_predicted)[:3, 3], atol=1e-12)


def test_with_depth_everywhere_the_prediction_stays(observed):
    before, observation = observed(0, first_row=0), observed(SHIFT_PX, first_row=0)
    assert (~before.has_depth).sum() < 50
    T_predicted = np.eye(4)
    assert turned(observation, before, T_predicted) is T_predicted


def test_without_any_depth_the_prediction_stays(observed):
    before, observation = observed(0, first_row=240), observed(SHIFT_PX, first_row=240)
    T_predicted = np.eye(4)
    assert turned(observation, before, T_predicted) is T_predicted


def test_features_that_agree_on_no_turn_are_not_used(observed):
    before, observation = observed(0, first_row=200), observed(SHIFT_PX, first_row=200)
    rng = np.random.default_rng(0)
    scattered = observation.measured.copy()
    scattered[:, :2] += rng.uniform(-40.0, 40.0, scattered[:, :2].shape)
    T_predicted = np.eye(4)
    assert turned(replace(observation, measured=scattered), before, T_predicted) is T_predicted
