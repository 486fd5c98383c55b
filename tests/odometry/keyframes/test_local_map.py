"""The default odometry on a short synthetic log: accurate, repeatable, and lost where it should be."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.doubts import Doubt
from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.geometry import exp, inverse
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.features.config import OrbConfig
from mapper.graph.config import GraphConfig
from mapper.graph.model import PoseGraph
from mapper.graph.optimize import optimize
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.keyframes.frame_doubts import Assessment
from mapper.odometry.keyframes.keyframe_decision import KeyframeDecision
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from tests.support.desk_frames import blank
from tests.support.paths import DATA


def solved(tracks, factors):
    """Return the trajectory, solved as the pipeline does."""
    graph = PoseGraph()
    for step in tracks:
        if step.is_keyframe:
            graph.add_node(step.node, step.stamp_ns, step.T_world_body)
    graph.add_factors(factors)
    T_world_node = optimize(graph, GraphConfig()).T_world_node
    placed = [step for step in tracks if step.node is not None]
    return trajectory_from((s.stamp_ns, T_world_node[s.node] @ s.T_node_body) for s in placed)


def track(frames, config=None):
    odometry = build_frame_odometry(config or LocalMapConfig())
    tracks = [odometry.track(odometry.observe(frame)) for frame in frames]
    return tracks, solved(tracks, odometry.finish())


def test_it_follows_the_truth_without_a_doubt(source, walked):
    tracks, odometry = walked
    assert all(step.node is not None and not step.doubts for step in tracks)
    assert ate_rmse_m(solved(tracks, odometry.finish()), source.truth) < 0.01
    assert 1 < sum(step.is_keyframe for step in tracks) < len(tracks) // 2


def test_plain_orb_works_as_well(source, frames):
    _, trajectory = track(frames, LocalMapConfig(detector=OrbConfig()))
    assert len(trajectory) == len(frames)
    assert ate_rmse_m(trajectory, source.truth) < 0.01


def test_the_same_walk_four_times_as_large_has_the_same_drift_per_metre(source, frames):
    """Then most walls are 4 to 12 m away. Drift may not depend on a limit of the depth."""
    large = [RgbdFrame(f.stamp_ns, f.image, 4.0 * f.depth_m, f.camera, f.T_body_camera) for f in frames]
    T_world_body = source.truth.T_world_body.copy()
    T_world_body[:, :3, 3] *= 4.0
    _, trajectory = track(large)
    assert len(trajectory) == len(frames)
    assert ate_rmse_m(trajectory, Trajectory(source.truth.stamps_ns, T_world_body)) < 4.0 * 0.01


def test_depth_beyond_the_limit_is_not_used(frames):
    def depth_m(**settings):
        config = LocalMapConfig(**settings)
        return build_frame_odometry(config).observe(frames[0]).points_camera[:, 2]

    every, near = depth_m(), depth_m(max_depth_m=1.4)
    assert np.nanmax(every) > 1.4
    assert np.array_equal(near, np.where(every <= 1.4, every, np.nan), equal_nan=True)


def test_a_camera_off_the_body_moves_the_same_world(frames):
    """T_body_camera only renames what the trajectory is the pose of."""
    T_body_camera = exp(np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.2, -0.3]))
    mounted = [RgbdFrame(f.stamp_ns, f.image, f.depth_m, f.camera, T_body_camera) for f in frames[:20]]
    _, camera = track(frames[:20])
    _, body = track(mounted)
    expected = T_body_camera @ camera.T_world_body @ inverse(T_body_camera)
    assert np.allclose(body.T_world_body, expected, atol=1e-6)


def test_covered_frames_are_lost_and_the_next_ones_are_found_again(source, frames):
    covered = [*frames[:15], *(blank(f) for f in frames[15:22]), *frames[22:]]

    tracks, trajectory = track(covered)

    lost = [i for i, step in enumerate(tracks) if step.node is None]
    assert lost == list(range(15, 22))
    assert all(tracks[i].diagnostics.method == "lost" for i in lost)
    assert tracks[22].diagnostics.method.startswith("relocalised")
    assert all((tracks[i].T_world_body == tracks[14].T_world_body).all() for i in lost)
    assert ate_rmse_m(trajectory, source.truth) < 0.01


def test_a_sudden_jump_is_bridged_by_matching(source, frames):
    jumped = [*frames[:12], *frames[24:]]
    tracks, trajectory = track(jumped)
    assert all(step.node is not None for step in tracks)
    assert ate_rmse_m(trajectory, source.truth) < 0.01


def test_a_jump_to_another_place_is_no_motion(frames):
    """Noise matches nothing: the honest answer is "lost"."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, frames[0].image.shape, dtype=np.uint8)
    stranger = RgbdFrame(frames[10].stamp_ns, noise, np.full_like(frames[0].depth_m, 2.0), frames[0].camera)
    tracks, _ = track([*frames[:10], stranger])
    assert tracks[-1].node is None


def test_nothing_starts_before_there_is_texture(frames):
    tracks, _ = track([blank(frames[0]), *frames[1:4]])
    assert [step.node for step in tracks[:2]] == [None, 0]
    assert tracks[1].is_keyframe


def test_a_view_that_is_mostly_new_becomes_a_keyframe(frames, monkeypatch):
    """The more of a view must be known, the more keyframes it takes."""
    counts = []
    for ratio in (0.0, 0.9):
        monkeypatch.setattr("mapper.odometry.keyframes.keyframe_decision.MAPPED_RATIO", ratio)
        counts.append(track(frames[:20], LocalMapConfig())[0])
    few, many = counts
    assert sum(step.is_keyframe for step in few) < sum(step.is_keyframe for step in many)


def test_factors_connect_every_keyframe_to_an_earlier_one(walked):
    tracks, odometry = walked
    keyframes, factors = sum(step.is_keyframe for step in tracks), odometry.finish()
    assert {factor.j for factor in factors} == set(range(1, keyframes))
    assert all(factor.i < factor.j for factor in factors)
    # A hundred landmarks at a metre or two pin a pose to millimetres, not to microns or metres.
    sigma_m = [float(np.sqrt(np.linalg.inv(factor.information)[3:, 3:].trace() / 3)) for factor in factors]
    assert 1e-4 < np.median(sigma_m) < 2e-2


def test_a_bare_scan_is_refused():
    scan = Scan(7, np.zeros((3, 3), np.float32))
    with pytest.raises(FrameError, match="needs colour and depth"):
        build_frame_odometry(LocalMapConfig()).observe(scan)


def test_an_image_without_features_is_observed_as_empty():
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    frame = RgbdFrame(0, np.zeros((48, 64), np.uint8), np.zeros((48, 64), np.float32), camera)
    assert len(build_frame_odometry(LocalMapConfig()).observe(frame)) == 0


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
