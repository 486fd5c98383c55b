"""Doubts of RGB-D frames: what is right is not doubted, and what may be wrong says why and by how much."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.doubts import Doubt, doubts_text
from mapper.core.frames import RgbdFrame
from mapper.core.geometry import exp
from mapper.odometry.base import REPEATED
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.local_map.depth.depth_alignment import DepthAlignment
from mapper.odometry.local_map.depth.earlier_depth import Displacement
from mapper.odometry.local_map.displaced_surfaces import DisplacedSurfaces
from mapper.odometry.local_map.frame_doubts import FrameDoubts
from mapper.odometry.local_map.pose.assessment import UNDOUBTED, Assessment
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT

NOT_DISPLACED = Displacement()


@pytest.fixture
def odometry():
    return build_frame_odometry(LocalMapConfig())


def track(frames, odometry):
    return [odometry.track(odometry.observe(frame)) for frame in frames]


def later(frame, of):
    """Return a frame with the stamp of another one."""
    return RgbdFrame(of.stamp_ns, frame.image, frame.depth_m, frame.camera, frame.T_body_camera)


def test_right_frames_are_not_doubted(frames, odometry):
    assert not any(step.doubts for step in track(frames, odometry))


def test_a_frozen_camera_is_doubted_until_it_moves_again(frames, odometry):
    frozen = [later(frames[29], of) for of in frames[30:36]]
    tracks = track([*frames[:30], *frozen, *frames[36:45]], odometry)

    doubtful = [i for i, step in enumerate(tracks) if any("same" in doubt.text for doubt in step.doubts)]
    assert doubtful == list(range(30, 36))
    assert not any(tracks[i].is_keyframe for i in doubtful)
    assert [i for i, step in enumerate(tracks) if step.diagnostics.method == REPEATED] == doubtful
    assert all(step.covariance is not None for step in tracks[30:36])
    sigmas_m = [np.sqrt(tracks[i].covariance[3, 3]) for i in doubtful]
    assert sigmas_m == sorted(sigmas_m)
    assert not tracks[-1].doubts


def test_doubts_are_measured_against_what_is_usual(frames, odometry):
    """A jump that is supported as well as the frames before it is a fast motion, and not doubted."""
    doubts = FrameDoubts()
    track(frames[:2], odometry)
    pose = odometry._last
    step_ns = 33_000_000

    def assess(
        k, *, moved_m=0.001, agreement=0.95, sigma_m=0.001, displaced=NOT_DISPLACED, moving=0, excess=0.0
    ):
        now = replace(
            pose,
            observation=replace(pose.observation, stamp_ns=k * step_ns, image_checksum=k),
            T_camera_world=exp(np.zeros(3), np.array([moved_m, 0.0, 0.0])) @ pose.T_camera_world,
            agreement=agreement,
            moving=np.arange(moving),
        )
        last = replace(pose, observation=replace(pose.observation, stamp_ns=(k - 1) * step_ns))
        covariance = np.diag([1e-6] * 3 + [sigma_m**2] * 3)
        return doubts.assess(now, covariance, last, pose.T_camera_world, displaced, excess)

    assert not any(assess(k).doubts for k in range(1, 30))
    assert not assess(30, moved_m=0.3).doubts
    doubt = assess(31, moved_m=0.3, agreement=0.7)
    assert doubts_text(doubt.doubts) == "jump of 0.30 m off the predicted place, 0.00 m is usual"
    assert doubt.sigma_m == pytest.approx(0.3, rel=0.01)
    assert (
        "which tell the translation to 0.050 m, 0.001 m is usual" in assess(32, sigma_m=0.05).doubts[0].text
    )
    assert "40% of the matches agree, 95% is usual" in doubts_text(assess(33, agreement=0.4).doubts)
    doubt = assess(34, displaced=Displacement(0.6, 0.15, 0.4))
    assert doubts_text(doubt.doubts) == "60% of the surfaces lie elsewhere than 0.4 s before"
    assert doubt.sigma_m == pytest.approx(0.15)
    assert not assess(35, displaced=Displacement(0.45, 0.15, 0.4)).doubts
    assert not assess(37, moved_m=0.1, excess=3.0).doubts
    assert not assess(38, excess=7.0).doubts
    doubt = assess(39, moved_m=0.1, excess=7.0)
    assert doubts_text(doubt.doubts) == "the image fits the predicted motion better by 7 standard errors"
    assert doubt.sigma_m == pytest.approx(0.1, rel=0.01)
    assert not assess(40, moved_m=0.01, excess=7.0).doubts
    assert not assess(41, moved_m=0.0065, agreement=0.7).doubts
    doubt = assess(42, moved_m=0.0065, moving=len(pose.observation) // 2)
    assert doubts_text(doubt.doubts) == "jump of 0.01 m off the predicted place, 0.00 m is usual"


def test_a_jump_of_a_pose_by_depth_is_doubted_unless_a_motion_was_predicted_alone(frames, odometry):
    """A wall that errors of its depth bend shows a motion along it that is none."""
    doubts = FrameDoubts()
    track(frames[:2], odometry)
    pose = odometry._last
    observed, blind = (Mock(spec=DepthAlignment, unobservable=text) for text in ("", "translation along x"))

    def assess(k, *, depth=observed, last_depth=observed, moved_m=0.001):
        poses = [
            replace(
                pose,
                observation=replace(pose.observation, stamp_ns=at * 33_000_000, image_checksum=at),
                T_camera_world=exp(np.zeros(3), np.array([x, 0.0, 0.0])) @ pose.T_camera_world,
                depth=alignment,
            )
            for at, x, alignment in ((k, moved_m, depth), (k - 1, 0.0, last_depth))
        ]
        covariance = np.diag([1e-6] * 6)
        return doubts.assess(poses[0], covariance, poses[1], pose.T_camera_world, NOT_DISPLACED, 0.0)

    assert not any(assess(k).doubts for k in range(1, 30))
    assert not assess(30, moved_m=0.005).doubts
    assert not assess(31, moved_m=0.3, depth=blind).doubts
    assert not assess(32, moved_m=0.3, last_depth=blind).doubts
    doubt = assess(33, moved_m=0.3)
    assert doubts_text(doubt.doubts) == "jump of 0.30 m off the predicted place, 0.00 m is usual"
    assert doubt.sigma_m == pytest.approx(0.3, rel=0.01)
    assert not doubt.repeats


@pytest.mark.parametrize("by_depth", [False, True])
def test_after_a_gap_matches_that_disagree_may_be_of_another_place(frames, odometry, by_depth):
    """The pose is then as uncertain as the way that the camera goes in that time."""
    doubts = FrameDoubts()
    track(frames[:2], odometry)
    pose = odometry._last
    depth = Mock(spec=DepthAlignment, unobservable="") if by_depth else None

    def assess(time_s, *, since_s, agreement, moved_m=0.01, depth=None):
        now, last = (
            replace(
                pose,
                observation=replace(
                    pose.observation, stamp_ns=round(1e9 * at), image_checksum=round(1e9 * at)
                ),
                T_camera_world=exp(np.zeros(3), np.array([x, 0.0, 0.0])) @ pose.T_camera_world,
                agreement=agreement,
                depth=depth,
            )
            for at, x in ((time_s, moved_m), (time_s - since_s, 0.0))
        )
        return doubts.assess(now, np.diag([1e-6] * 6), last, None, NOT_DISPLACED, 0.0)

    for k in range(1, 30):  # at 0.1 m/s
        assess(0.1 * k, since_s=0.1, agreement=0.95)
    assert not assess(5.0, since_s=2.0, agreement=0.6, depth=depth).doubts
    doubt = assess(7.0, since_s=2.0, agreement=0.4, depth=depth)
    assert doubts_text(doubt.doubts) == "40% of the matches agree, 95% is usual"
    assert doubt.sigma_m == pytest.approx(0.2, rel=0.01)
    soon = assess(7.5, since_s=0.5, agreement=0.4, depth=depth)
    assert bool(soon.doubts) == (not by_depth)
    assert soon.sigma_m < 0.01


def test_a_frozen_camera_before_white_walls_is_doubted(frames, odometry):
    track(frames[:2], odometry)
    depth = Mock(spec=DepthAlignment, unobservable="translation along x")
    last, now = (
        replace(
            odometry._last,
            observation=replace(odometry._last.observation, stamp_ns=at, image_checksum=1),
            depth=depth,
        )
        for at in (0, 200_000_000)
    )
    doubts, covariance = FrameDoubts(), np.diag([1e-6] * 6)
    doubts.assess(last, covariance, odometry._before_last, None, NOT_DISPLACED, 0.0)
    doubt = doubts.assess(now, covariance, last, None, NOT_DISPLACED, 0.0)
    assert doubts_text(doubt.doubts) == "the image has been the same for 0.20 s"
    assert doubt.repeats


def test_where_much_moves_the_farther_surfaces_decide_also_of_frames_shortly_before(frames, odometry):
    surfaces = DisplacedSurfaces()
    track(frames[:2], odometry)
    pose = odometry._last

    def doubt(time_s, *, moving, ratio=0.0, far_ratio=0.0):
        now = replace(
            pose,
            observation=replace(pose.observation, stamp_ns=round(time_s * 1e9)),
            moving=np.arange(moving * len(pose.observation)),
        )
        return surfaces.doubt_of(now, Displacement(ratio, 0.15, 0.4, far_ratio))

    assert not doubt(1.0, moving=0.0, ratio=0.3, far_ratio=0.6)
    assert not doubt(2.5, moving=0.0, ratio=0.3, far_ratio=0.6)
    assert not doubt(2.6, moving=0.0, ratio=0.3, far_ratio=0.1)
    assert not surfaces.doubt_of_earlier(2_500_000_000).doubts
    assert not doubt(4.0, moving=0.4, ratio=0.6, far_ratio=0.1)
    assert doubt(4.1, moving=0.0, ratio=0.3, far_ratio=0.6).kind == "displaced farther surfaces"

    earlier = surfaces.doubt_of_earlier(2_500_000_000)
    assert doubts_text(earlier.doubts) == "60% of the farther surfaces lie elsewhere than 0.4 s before"
    assert earlier.sigma_m == 0.15
    assert not any(surfaces.doubt_of_earlier(ns).doubts for ns in (1_000_000_000, 2_600_000_000))


def test_what_later_frames_say_against_a_frame_is_in_its_result_and_its_factors(source, monkeypatch):
    elsewhere = Assessment((Doubt("elsewhere", "elsewhere"),), 0.0, 0.3)
    config = load_config(None, ["loops.kind=none"], sensor="rgbd")
    before = track_log(source, config, progress=SILENT)
    keyframe = next(track for track in before.tracks if track.node == 1)
    monkeypatch.setattr(
        FrameDoubts,
        "in_hindsight",
        lambda _, ns: elsewhere if ns == keyframe.stamp_ns else UNDOUBTED,
    )
    after = track_log(source, config, progress=SILENT)

    assert [track.stamp_ns for track in after.tracks if track.doubts] == [keyframe.stamp_ns]
    doubtful = next(track for track in after.tracks if track.doubts)
    added = np.diag(doubtful.covariance - keyframe.covariance)
    assert added == pytest.approx([0.0] * 3 + [0.09] * 3, abs=1e-9)
    factor = next(factor for factor in after.graph.factors if factor.j == 1)
    assert np.sqrt(np.linalg.inv(factor.information)[3, 3]) == pytest.approx(0.3, rel=0.01)


def test_factors_of_a_doubtful_keyframe_tell_less(frames, odometry):
    track(frames, odometry)
    before = [factor for factor in odometry.finish() if factor.j == 1]
    odometry._map.keyframes[1].doubt_rad, odometry._map.keyframes[1].doubt_m = 0.1, 0.2
    after = [factor for factor in odometry.finish() if factor.j == 1]

    sigma_m = [np.sqrt(np.linalg.inv(factor.information)[3, 3]) for factor in (*before, *after)]
    assert len(sigma_m) == 2
    assert sigma_m[0] < 0.02
    assert sigma_m[1] == pytest.approx(np.hypot(0.2, sigma_m[0]), rel=1e-3)
