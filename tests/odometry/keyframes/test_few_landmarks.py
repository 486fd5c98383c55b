"""Frames of few landmarks: the next ones are tracked by them, however much speaks against their poses."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.doubts import Doubt
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.keyframes.frame_doubts import Assessment
from mapper.odometry.keyframes.keyframe_decision import KeyframeDecision
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from tests.support.paths import DATA

CABINET = DATA / "tum_fr3_cabinet_1_5hz"
DOUBT = Doubt("disagreement", "0 of 20 features agree with the depth image")


@pytest.mark.parametrize(("inliers", "is_due"), [(20, True), (200, False)])
def test_a_doubtful_frame_is_a_keyframe_if_its_landmarks_are_few(frames, inliers, is_due):
    odometry = build_frame_odometry(LocalMapConfig())
    for frame in frames[:2]:
        odometry.track(odometry.observe(frame))
    pose = odometry._last
    landmark_of_feature = np.where(np.arange(len(pose.observation)) < inliers, 0, -1).astype(np.int32)
    decision = KeyframeDecision(LocalMapConfig())
    decision.is_due(replace(pose, doubts=()), Assessment())  # which had all of its landmarks

    few = replace(pose, landmark_of_feature=landmark_of_feature, doubts=(DOUBT,))

    assert decision.is_due(few, Assessment((DOUBT,), 0.1, 0.1)) is is_due


@pytest.mark.slow
@pytest.mark.skipif(not CABINET.exists(), reason="needs ../shared/data/tum_fr3_cabinet_1_5hz")
def test_a_camera_at_its_true_rate_of_1_5_hz_loses_no_frame():
    log = open_source(CABINET)
    tracks = track_log(log, load_config(None, [], sensor="rgbd"), progress=SILENT).tracks

    assert all(track.node is not None for track in tracks)
    assert sum(track.is_keyframe and not track.doubts for track in tracks) >= 40
