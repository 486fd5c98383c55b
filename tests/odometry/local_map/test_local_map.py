"""The default odometry on a short synthetic log: accurate, repeatable, and lost where it should be."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.geometry import exp, inverse
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.features.config import OrbConfig
from mapper.graph.config import GraphConfig
from mapper.graph.model import PoseGraph
from mapper.graph.optimize import optimize
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.local_map.keyframe_decision import KeyframeDecision
from mapper.sensing.config import DepthNoiseConfig
from tests.support.desk_frames import ate_rmse_m, blank


def track(frames, config=None):
    """Track, solve as the pipeline does, and return tracks and trajectory."""
    odometry = build_frame_odometry(config or LocalMapConfig())
    graph = PoseGraph()
    tracks = []
    for frame in frames:
        step = odometry.track(odometry.observe(frame))
        if step.is_keyframe:
            graph.add_node(step.node, step.stamp_ns, step.T_world_body)
        tracks.append(step)
    graph.add_factors(odometry.finish())
    T_world_node = optimize(graph, GraphConfig()).T_world_node
    placed = [step for step in tracks if step.node is not None]
    return tracks, trajectory_from((s.stamp_ns, T_world_node[s.node] @ s.T_node_body) for s in placed)


def test_it_follows_the_truth(source, frames):
    tracks, trajectory = track(frames)
    assert all(step.node is not None for step in tracks)
    assert ate_rmse_m(trajectory, source.truth) < 0.01
    assert 1 < sum(step.is_keyframe for step in tracks) < len(frames) // 2


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


def test_disparities_weigh_what_the_residuals_of_a_log_show(frames):
    """A measured noise of the sensor is taken as it is."""

    def relative_weight(**settings):
        odometry = build_frame_odometry(LocalMapConfig(keyframe_ratio=0.99, mapped_ratio=0.95, **settings))
        for frame in frames:
            odometry.track(odometry.observe(frame))
        assert len(odometry._map.keyframes) > 10
        observation = odometry._last.observation
        weights = observation.weights[observation.has_depth & ~observation.on_outline]
        return weights[:, 2] / weights[:, 0], odometry._mapping.residuals.disparity_sigma**-2

    weight, expected = relative_weight()
    assert expected > 1.5
    assert np.allclose(weight, expected)
    noise = DepthNoiseConfig(constant_m=0.01)
    kept, _ = relative_weight(depth_noise=noise)
    assert np.ptp(kept) > 0.0


def test_keyframes_in_which_much_moves_keep_the_usual_weight(frames):
    odometry = build_frame_odometry(LocalMapConfig())
    for frame in frames[:10]:
        odometry.track(odometry.observe(frame))
    odometry._mapping.residuals.disparity_sigma = 0.5

    def relative_weights(moving):
        last = replace(odometry._last, moving=np.arange(moving, dtype=np.int32))
        observation = odometry._mapping.add_keyframe(
            last, neighbour=last.reference, twist_camera=np.zeros(6)
        ).observation
        weights = observation.weights[observation.has_depth & ~observation.on_outline]
        return np.unique(np.round(weights[:, 2] / weights[:, 0], 6))

    assert relative_weights(moving=0) == 4.0
    assert relative_weights(moving=len(odometry._last.observation) // 2) == 1.0


def test_bundles_have_the_usual_variances_until_a_window_of_keyframes_is_still(frames, monkeypatch):
    odometry = build_frame_odometry(LocalMapConfig(bundle_keyframes=3))
    for frame in frames:
        odometry.track(odometry.observe(frame))
    factors = []
    monkeypatch.setattr(odometry._map, "refine", lambda _, **given: factors.append(given["variance_factor"]))
    for moving in (0, len(odometry._last.observation) // 2, 0, 0, 0):
        last = replace(odometry._last, moving=np.arange(moving, dtype=np.int32))
        odometry._mapping.add_keyframe(last, neighbour=last.reference, twist_camera=np.zeros(6))
    assert factors[1:4] == [1.0, 1.0, 1.0]
    assert factors[0] < 1.0
    assert factors[4] < 1.0


def test_the_residuals_of_a_log_decide_what_is_an_outlier_of_a_bundle(frames):
    odometry = build_frame_odometry(LocalMapConfig())
    for frame in frames:
        odometry.track(odometry.observe(frame))
    landmark_map, index = odometry._map, odometry._last.reference
    ids, octave = landmark_map.landmark_of_feature(index), landmark_map.observation(index).octave
    feature = np.flatnonzero((octave == 0) & (landmark_map.landmarks["observers"][ids] > 2) & (ids >= 0))[0]
    landmark_map._observations["measured"][landmark_map._first_observation[index] + feature, 0] += 2.0

    def is_kept(variance_factor):
        landmark_map.refine(index, window=10, variance_factor=variance_factor)
        return landmark_map.landmark_of_feature(index)[feature] >= 0

    assert is_kept(1.0)
    assert not is_kept(0.1)


def test_the_same_frames_give_the_same_bytes(frames):
    first, second = (track(frames[:20])[1] for _ in range(2))
    assert first.T_world_body.tobytes() == second.T_world_body.tobytes()


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


def test_a_view_that_is_mostly_new_becomes_a_keyframe(frames):
    """The more of a view must be known, the more keyframes it takes."""
    few, many = (track(frames[:20], LocalMapConfig(mapped_ratio=ratio))[0] for ratio in (0.0, 0.9))
    assert sum(step.is_keyframe for step in few) < sum(step.is_keyframe for step in many)


def test_a_keyframe_is_recent_for_a_time_and_not_only_for_frames(frames):
    """At 5 Hz the view changes within a few frames, which must not wait for the next keyframe."""
    odometry = build_frame_odometry(LocalMapConfig(mapped_ratio=0.0))
    odometry.track(odometry.observe(frames[0]))
    first = odometry._last

    def seen(after_s, share):
        count = int(share * len(first.observation))
        landmark_of_feature = np.where(
            np.arange(len(first.observation)) < count, first.landmark_of_feature, -1
        )
        observation = replace(first.observation, stamp_ns=first.stamp_ns + round(1e9 * after_s))
        return replace(first, observation=observation, landmark_of_feature=landmark_of_feature)

    def is_due(period_s):
        decision = KeyframeDecision(odometry._config, odometry._map)
        assert not decision.is_due(seen(period_s, 1.0))
        return decision.is_due(seen(2.0 * period_s, 0.65))

    assert seen(0.0, 0.65).inliers >= odometry._config.weak_inliers
    assert not is_due(1.0 / 30.0)
    assert is_due(1.0 / 5.0)


def test_factors_connect_every_keyframe_to_an_earlier_one(frames):
    odometry = build_frame_odometry(LocalMapConfig())
    keyframes = sum(odometry.track(odometry.observe(frame)).is_keyframe for frame in frames)
    factors = odometry.finish()
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
