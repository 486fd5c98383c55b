"""Doubts of RGB-D frames: what is right is not doubted, and what may be wrong says why and by how much."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.frames import RgbdFrame
from mapper.core.geometry import exp
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.keyframes.depth_comparison import Displacement
from mapper.odometry.keyframes.frame_doubts import FrameDoubts
from mapper.runtime.state_file import dumps, loads

NOT_DISPLACED = Displacement()


@pytest.fixture
def odometry():
    return build_frame_odometry(LocalMapConfig())


def track(frames, odometry):
    return [odometry.track(odometry.observe(frame)) for frame in frames]


def later(frame, of):
    """Return a frame with the stamp of another one."""
    return RgbdFrame(of.stamp_ns, frame.image, frame.depth_m, frame.camera, frame.T_body_camera)


def test_a_frozen_camera_is_doubted_until_it_moves_again(frames, odometry):
    frozen = [later(frames[29], of) for of in frames[30:36]]
    tracks = track([*frames[:30], *frozen, *frames[36:45]], odometry)

    doubtful = [i for i, step in enumerate(tracks) if "repeated image" in {d.kind for d in step.doubts}]
    assert doubtful == list(range(30, 36))
    assert not any(tracks[i].is_keyframe for i in doubtful)
    assert all(step.covariance is not None for step in tracks[30:36])
    sigmas_m = [np.sqrt(tracks[i].covariance[3, 3]) for i in doubtful]
    assert sigmas_m == sorted(sigmas_m)
    assert not tracks[-1].doubts


def test_images_at_two_stamps_each_move_as_at_their_first(frames, odometry):
    slow = frames[:40:2]
    again = [later(frame, frames[2 * k + 1]) for k, frame in enumerate(slow)]
    tracks = track([frame for pair in zip(slow, again, strict=True) for frame in pair], odometry)
    of_slow = build_frame_odometry(LocalMapConfig())
    known = track(slow, of_slow)
    assert [bool(step.doubts) for step in tracks] == [False, True] * 20
    places_m, known_m = (
        np.array([step.T_world_body[:3, 3] for step in steps]) for steps in (tracks[::2], known)
    )
    np.testing.assert_allclose(places_m, known_m, atol=0.01)
    np.testing.assert_allclose(odometry._shutter.twist_camera, of_slow._shutter.twist_camera, atol=0.02)


def kinds(assessment):
    return [doubt.kind for doubt in assessment.doubts]


def test_doubts_are_measured_against_what_is_usual(frames, odometry):
    doubts = FrameDoubts()
    track(frames[:2], odometry)
    pose = odometry._last
    step_ns = 33_000_000

    def assess(k, *, moved_m=0.001, displaced=NOT_DISPLACED):
        now = replace(
            pose,
            observation=replace(pose.observation, stamp_ns=k * step_ns),
            T_camera_world=exp(np.zeros(3), np.array([moved_m, 0.0, 0.0])) @ pose.T_camera_world,
        )
        last = replace(pose, observation=replace(pose.observation, stamp_ns=(k - 1) * step_ns))
        return doubts.assess(now, 1e-6 * np.eye(6), last, pose.T_camera_world, displaced, repeats=False)

    assert not any(assess(k).doubts for k in range(1, 30))
    assert not assess(30, moved_m=0.005).doubts
    jump = assess(31, moved_m=0.3)
    assert kinds(jump) == ["jump"]
    assert jump.sigma_m == pytest.approx(0.3, rel=0.01)
    displaced = assess(34, displaced=Displacement(0.6, 0.15, 0.4))
    assert kinds(displaced) == ["elsewhere"]
    assert displaced.sigma_m == pytest.approx(0.15)
    assert not assess(35, displaced=Displacement(0.45, 0.15, 0.4)).doubts


def test_factors_of_a_doubtful_keyframe_tell_less(walked):
    odometry = loads(dumps(walked[1]))
    before = [factor for factor in odometry.finish() if factor.j == 1]
    odometry._map.keyframes[1].doubt_rad, odometry._map.keyframes[1].doubt_m = 0.1, 0.2
    after = [factor for factor in odometry.finish() if factor.j == 1]

    sigma_m = [np.sqrt(np.linalg.inv(factor.information)[3, 3]) for factor in (*before, *after)]
    assert len(sigma_m) == 2
    assert sigma_m[0] < 0.02
    assert sigma_m[1] == pytest.approx(np.hypot(0.2, sigma_m[0]), rel=1e-3)
