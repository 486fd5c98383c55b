"""Frames that followed something else are relocalised; implausible poses are lost."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.core.geometry import exp, inverse, log
from mapper.odometry.local_map.depth.earlier_depth import Displacement
from mapper.odometry.local_map.pose.assessment import Assessment
from mapper.odometry.local_map.pose.pose_tracker import unmatched
from tests.support.desk_frames import odometry_after

NOW = 42
STILL = np.zeros(6)
T_ASIDE = exp(np.array([0.0, 0.05, 0.0]), np.array([0.0, 0.0, 0.3]))


@pytest.fixture
def odometry(frames):
    return odometry_after(frames[:NOW])


def miss_m(pose, right):
    return float(np.linalg.norm(log(pose.T_camera_world @ inverse(right.T_camera_world))[1]))


def astray(pose):
    """Return the pose of a frame that followed something else, all of whose landmarks are new."""
    return replace(
        pose,
        T_camera_world=T_ASIDE @ pose.T_camera_world,
        landmark_of_feature=unmatched(pose.observation),
    )


def test_a_pose_that_displaces_most_surfaces_is_recognised_where_it_is(odometry):
    right = odometry._last
    wrong = astray(right)
    displaced = odometry._earlier_depth.displacement(
        right.observation, wrong.T_camera_world, right.reference, STILL
    )
    assert max(displaced.ratio, displaced.far_ratio) > 0.5
    found, then = odometry._recovery.relocalised(wrong, displaced, STILL)
    assert miss_m(found, right) < 0.02
    assert max(then.ratio, then.far_ratio) < 0.25
    assert "recognised 0.3" in found.doubts[-1].text


def test_what_follows_from_a_doubtful_keyframe_is_recognised_until_it_is_linked(odometry):
    right, nothing = odometry._last, Displacement()
    assert odometry._recovery.relocalised(astray(right), nothing, STILL) is None
    odometry._map.keyframes[-1].doubt_m = 0.3
    found, _ = odometry._recovery.relocalised(astray(right), nothing, STILL)
    assert miss_m(found, right) < 0.02
    assert odometry._recovery.relocalised(found, nothing, STILL) is None  # rests on landmarks of before


@pytest.mark.parametrize(("off_m", "is_recognised"), [(0.3, True), (5.0, False)])
def test_nothing_is_recognised_farther_off_than_doubtful_keyframes_can_have_led(
    odometry, off_m, is_recognised
):
    """What hangs on two walls alike agrees with a pose before the other one."""
    odometry._map.keyframes[-1].doubt_m = 0.3
    pose = astray(odometry._last)
    pose = replace(pose, T_camera_world=exp(np.zeros(3), np.array([0.0, 0.0, off_m])) @ pose.T_camera_world)
    found = odometry._recovery.relocalised(pose, Displacement(), STILL)
    assert (found is not None) == is_recognised


def test_a_recognised_frame_is_doubtful_no_keyframe_and_where_it_is(odometry, frames, monkeypatch):
    observation = odometry.observe(frames[NOW])
    track = odometry._estimator._tracker.track
    wrong = Mock(side_effect=lambda *arguments: astray(track(*arguments)))
    monkeypatch.setattr(odometry._estimator._tracker, "track", wrong)
    monkeypatch.setattr(odometry._estimator._depth, "supported", lambda *arguments: arguments[-1])
    result = odometry.track(observation)
    monkeypatch.undo()
    assert not result.is_keyframe
    assert any("recognised" in doubt.text for doubt in result.doubts)
    after = odometry.track(odometry.observe(frames[NOW + 1]))
    assert not after.doubts
    assert np.linalg.norm(log(inverse(result.T_world_body) @ after.T_world_body)[1]) < 0.03


@pytest.mark.parametrize(("inliers", "outcome"), [(40, "lost"), (400, "doubtful")])
def test_an_implausible_pose_of_few_features_is_lost(odometry, frames, monkeypatch, inliers, outcome):
    track = odometry._estimator._tracker.track

    def with_inliers(*arguments):
        pose = track(*arguments)
        ids = pose.landmark_of_feature.copy()
        ids[np.flatnonzero(ids >= 0)[inliers:]] = -1
        return replace(pose, landmark_of_feature=ids)

    monkeypatch.setattr(odometry._estimator._tracker, "track", with_inliers)
    monkeypatch.setattr(odometry._estimator._depth, "supported", lambda *arguments: arguments[-1])
    implausible = Assessment((Doubt("jump", "jump"),), 0.1, 0.5, is_implausible=True)
    monkeypatch.setattr(odometry._doubts, "assess", lambda *_: implausible)
    before = odometry._last
    result = odometry.track(odometry.observe(frames[NOW]))
    assert (result.node is None) == (outcome == "lost")
    assert bool(result.doubts) == (outcome == "doubtful")
    assert (odometry._last is before) == (outcome == "lost")


@pytest.mark.parametrize(("moves", "first"), [(True, True), (False, False)])
def test_among_what_moves_the_predicted_pose_needs_no_more_features(odometry, moves, first):
    pose = odometry._last
    ids = pose.landmark_of_feature.copy()
    ids[np.flatnonzero(ids >= 0)[::3]] = -1
    moving = np.arange(len(ids) // 5, dtype=np.int32) if moves else np.empty(0, np.int32)
    predicted = replace(pose, landmark_of_feature=ids, moving=moving, method="map")
    other = replace(pose, T_camera_world=T_ASIDE @ pose.T_camera_world, method="fallback")
    best = odometry._estimator._tracker._better(predicted, other)
    assert best.method == ("map" if first else "fallback")


@pytest.mark.parametrize(
    ("inliers", "aside", "outcome"), [(40, True, "lost"), (40, False, "found"), (400, True, "found")]
)
def test_after_a_loss_a_pose_of_few_features_that_displaces_surfaces_is_not_taken(
    odometry, frames, monkeypatch, inliers, aside, outcome
):
    track, last = odometry._estimator._tracker.track, odometry._last

    def recognised(observation, *_):
        pose = track(observation, last, None)
        ids = pose.landmark_of_feature.copy()
        ids[np.flatnonzero(ids >= 0)[inliers:]] = -1
        T_camera_world = T_ASIDE @ pose.T_camera_world if aside else pose.T_camera_world
        return replace(pose, T_camera_world=T_camera_world, landmark_of_feature=ids)

    monkeypatch.setattr(odometry._estimator, "estimate", recognised)
    monkeypatch.setattr(odometry._recovery, "relocalised", lambda *_: None)
    odometry._lost.count = 1
    result = odometry.track(odometry.observe(frames[NOW]))
    assert (result.node is None) == (outcome == "lost")
