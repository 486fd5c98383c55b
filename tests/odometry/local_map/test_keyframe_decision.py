"""Which doubts keep a frame from becoming a keyframe."""

from types import SimpleNamespace

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.local_map.keyframe_decision import KeyframeDecision
from mapper.odometry.local_map.pose.assessment import UNOBSERVED_MOTION

UNOBSERVED = Doubt(UNOBSERVED_MOTION, "neither depth nor features show translation along x for 0.4 s")
JUMP = Doubt("jump", "jump of 0.3 m")


@pytest.mark.parametrize(
    ("unobservable", "doubts", "is_due"),
    [
        ("translation along x", (UNOBSERVED,), True),
        ("translation along x", (UNOBSERVED, JUMP), False),
        ("translation along x", (JUMP,), False),  # not observed too briefly for a doubt of its own
        ("", (JUMP,), False),
        ("", (), True),
    ],
)
def test_only_a_doubt_that_the_covariance_measures_lets_a_frame_become_a_keyframe(
    unobservable, doubts, is_due
):
    config = LocalMapConfig(max_keyframe_gap=1)
    depth = SimpleNamespace(unobservable=unobservable, observes_next=False)
    decision = KeyframeDecision(config, landmark_map=None)

    assert decision.is_due(SimpleNamespace(inliers=100, depth=depth, doubts=doubts)) is is_due


@pytest.mark.parametrize(("with_depth", "is_due"), [(40, False), (80, True)])
def test_features_with_depth_that_are_no_landmarks_yet_end_tracking_by_depth(with_depth, is_due):
    decision = KeyframeDecision(LocalMapConfig(), landmark_map=None)
    tracked_pose = SimpleNamespace(
        inliers=0,
        depth=SimpleNamespace(unobservable="rotation about y", observes_next=False, overlap=1.0),
        doubts=(UNOBSERVED,),
        observation=SimpleNamespace(has_depth=np.arange(800) < with_depth),
    )
    due = [decision.is_due(tracked_pose) for _ in range(4)]
    assert due == [False, False, False, is_due]
