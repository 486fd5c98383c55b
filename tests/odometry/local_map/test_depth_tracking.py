"""The default odometry where images show little: depth continues the path, or says what it does not show."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.local_map import depth_tracker
from tests.support.depth_rooms import CORNER, white_frame
from tests.support.desk_frames import ate_rmse_m

ROOM = (1.6, 2.1, 1.3)
FACING_Y = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
STEP_NS = 66_666_667


def track(frames, *, align_depth=True):
    odometry = build_frame_odometry(LocalMapConfig(align_depth=align_depth))
    tracks = [odometry.track(odometry.observe(frame)) for frame in frames]
    return tracks, odometry.finish()


def walk(poses, half_m):
    rng = np.random.default_rng(0)
    return [white_frame(k * STEP_NS, T, half_m, rng=rng) for k, T in enumerate(poses)]


def swaying():
    """Poses before a corner, a metre along in all."""
    turns = [0.15 * np.sin(0.2 * k) * np.array([0.3, 1.0, 0.2]) for k in range(36)]
    return [
        CORNER @ exp(turn, np.array([0.25 * np.sin(0.15 * k), 0.1 * np.sin(0.2 * k), 0.01 * k]))
        for k, turn in enumerate(turns)
    ]


@pytest.fixture(scope="module")
def white_room():
    poses = swaying()
    return poses, *track(walk(poses, ROOM))


def test_a_white_room_is_tracked_on_its_walls(white_room):
    poses, tracks, _ = white_room
    assert [step.diagnostics.method for step in tracks] == ["start"] + ["depth"] * (len(poses) - 1)
    assert not any(step.doubts for step in tracks)
    truth = Trajectory(np.array([step.stamp_ns for step in tracks]), np.array(poses))
    path_m = float(np.linalg.norm(np.diff(truth.positions_world, axis=0), axis=1).sum())
    found = trajectory_from((step.stamp_ns, step.T_world_body) for step in tracks)
    assert ate_rmse_m(found, truth) < 0.01 * path_m


def test_its_figures_are_those_of_the_depth_image(white_room):
    _, tracks, _ = white_room
    figures = tracks[5].diagnostics
    assert figures.features == 0
    assert figures.residual_unit == "m"
    assert 0.001 < figures.residual < 0.03
    assert 0.9 * figures.matches < figures.inliers <= figures.matches


def test_its_keyframes_are_joined_by_what_depth_knows(white_room):
    _, tracks, factors = white_room
    keyframes = sum(step.is_keyframe for step in tracks)
    assert keyframes > 1
    assert {factor.j for factor in factors} == set(range(1, keyframes))
    for factor in factors:
        sigma_m = np.sqrt(np.linalg.inv(factor.information)[3:, 3:].diagonal())
        assert (sigma_m > 5e-4).all()
        assert (sigma_m < 0.02).all()


def test_poses_are_less_certain_after_distortion_was_removed(white_room):
    poses, tracks, factors = white_room
    frames = [replace(frame, removed_distortion_per_m=0.005) for frame in walk(poses, ROOM)]
    corrected, links = track(frames)
    for one, other in zip(tracks[1:], corrected[1:], strict=True):
        np.testing.assert_allclose(one.T_world_body, other.T_world_body, atol=1e-12)
        assert np.trace(other.covariance) > np.trace(one.covariance)
    for one, other in zip(factors, links, strict=True):
        assert np.trace(np.linalg.inv(other.information)) > 1.2 * np.trace(np.linalg.inv(one.information))


@pytest.mark.parametrize("shift_m", [0.05, 0.1, 0.2])
def test_keyframes_before_a_doubtful_motion_are_not_aligned_to(shift_m):
    poses = swaying()
    frames = walk(poses, ROOM)
    odometry = build_frame_odometry(LocalMapConfig())
    tracks = [odometry.track(odometry.observe(frame)) for frame in frames[:30]]
    keyframes = odometry._map.keyframes
    last = max(k for k, step in enumerate(tracks) if step.is_keyframe)
    assert len(keyframes) >= 3
    for keyframe in keyframes[:-1]:
        keyframe.T_camera_world = keyframe.T_camera_world @ exp(np.zeros(3), np.full(3, shift_m))
    keyframes[-1].doubt_m = shift_m
    step = odometry.track(odometry.observe(frames[30]))
    assert step.node == len(keyframes) - 1
    T_true = inverse(poses[last]) @ poses[30]
    assert np.linalg.norm((inverse(T_true) @ step.T_node_body)[:3, 3]) < 0.01


def test_it_is_the_same_every_time(white_room):
    poses, tracks, _ = white_room
    again, _ = track(walk(poses, ROOM)[:10])
    for one, other in zip(tracks[:10], again, strict=True):
        assert (one.T_world_body == other.T_world_body).all()


def test_without_the_depth_leg_it_is_lost():
    tracks, _ = track(walk(swaying()[:4], ROOM), align_depth=False)
    assert all(step.node is None for step in tracks)


@pytest.mark.parametrize(("most", "begins"), [(15, True), (0, False)])
def test_a_white_room_is_mapped_anew_once_a_gap_has_ended_its_map(most, begins):
    poses = swaying()
    frames = walk([*poses[:5], *[pose @ exp(np.array([0.0, 0.5, 0.0]), np.zeros(3)) for pose in poses]], ROOM)
    odometry = build_frame_odometry(LocalMapConfig(max_lost_frames=most))
    tracks = [odometry.track(odometry.observe(frame)) for frame in [*frames[:5], *frames[25:]]]
    after = tracks[5:]
    assert all((step.node is not None) == begins for step in after)
    linked = {factor.i for factor in odometry.finish() if factor.j >= (after[0].node or 0)}
    assert not begins or min(linked) >= after[0].node


def test_a_map_does_not_begin_before_a_bare_wall():
    poses = [FACING_Y @ exp(np.zeros(3), np.array([0.02 * k, 0.0, 0.0])) for k in range(5)]
    tracks, _ = track(walk(poses, (50.0, 1.5, 50.0)))
    assert all(step.node is None for step in tracks)


def test_what_a_wall_does_not_show_is_told():
    """The camera turns from a corner to a wall and goes along it; floor and ceiling stay in view."""
    half_m = (2.5, 1.5, 0.5)
    poses = []
    for k in range(45):
        yaw = 0.8 - 0.1 * min(k, 8)
        turned = FACING_Y @ exp(np.array([0.0, yaw, 0.0]), np.zeros(3))
        turned[0, 3] = 1.4 - 0.04 * k
        poses.append(turned)

    tracks, _ = track(walk(poses, half_m))

    blind = [step for step in tracks[20:] if step.node is not None]
    assert blind
    assert all("translation along x" in doubt.text for step in blind for doubt in step.doubts)
    assert all(step.doubts for step in blind)
    assert all(step.diagnostics.unobservable for step in blind)
    for step, truth in zip(tracks, poses, strict=True):
        if step.node is not None and not step.doubts:
            error = inverse(step.T_world_body) @ inverse(poses[0]) @ truth
            assert np.linalg.norm(error[:3, 3]) < 0.02


def test_the_second_frame_of_a_map_is_doubtful_where_depth_does_not_show_all():
    """Nothing predicts its motion yet: that the camera stood still would be a guess."""
    sideways = FACING_Y @ exp(np.array([0.0, 0.8, 0.0]), np.zeros(3))
    sideways[0, 3] = 1.3
    poses = [sideways @ exp(np.zeros(3), np.array([0.03 * k, 0.0, 0.0])) for k in range(3)]
    frames = walk(poses, (2.5, 1.5, 0.5))
    for frame in frames[1:]:
        frame.depth_m[:, :70] = 0.0  # the end wall

    tracks, _ = track(frames)

    assert tracks[0].node is not None
    assert all("translation along" in doubt.text for step in tracks[1:] for doubt in step.doubts)
    assert all(step.doubts for step in tracks[1:])
    assert np.linalg.eigvalsh(tracks[1].covariance)[-1] > 0.1**2


def test_a_blind_stretch_leaves_a_factor_that_is_as_uncertain():
    """From one corner along a bare wall to the other: how far along is a guess, and the graph knows."""
    turn = [*np.linspace(0.8, 0.0, 9), *[0.0] * 9, *np.linspace(0.0, -0.8, 9), *[-0.8] * 6]
    poses = []
    for k, yaw in enumerate(turn):
        T_world_camera = FACING_Y @ exp(np.array([0.0, yaw, 0.0]), np.zeros(3))
        T_world_camera[0, 3] = 1.3 - 0.08 * min(k, 32)
        poses.append(T_world_camera)

    tracks, factors = track(walk(poses, (2.5, 1.5, 0.5)))

    assert any(step.doubts for step in tracks)
    assert all(step.node is not None and not step.doubts for step in tracks[-4:])
    nodes = [step.node for step in tracks]
    sigma_m = {
        factor.j: float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(factor.information)[3:, 3:])[-1]))
        for factor in factors
    }
    between = [sigma_m[j] for j in range(1, nodes[-1] + 1)]
    assert max(between) > 0.1
    assert between[0] < 0.01
    assert between[-1] < 0.01
    blind = [float(np.linalg.eigvalsh(step.covariance)[-1]) ** 0.5 for step in tracks if step.doubts]
    assert blind[-1] > 0.1
    assert blind[-1] > 1.5 * blind[0]  # it grows with the time that nothing was seen
    assert np.linalg.eigvalsh(tracks[-1].covariance)[-1] < 0.01**2


def test_black_images_are_bridged_by_depth(source, frames):
    black = [replace(f, image=np.zeros_like(f.image)) if 15 <= k < 25 else f for k, f in enumerate(frames)]

    tracks, _ = track(black)

    assert all(step.node is not None for step in tracks)
    assert {step.diagnostics.method for step in tracks[15:25]} == {"depth"}
    assert not any(step.doubts for step in tracks)
    found = trajectory_from((step.stamp_ns, step.T_world_body) for step in tracks)
    assert ate_rmse_m(found, source.truth) < 0.01


def test_a_hand_before_the_lens_is_no_ground_to_stand_on(source, frames):
    """It moves with the camera, so that most of the depth image says that the camera stands still."""

    def covered(frame):
        depth_m = frame.depth_m.copy()
        depth_m[:, :240] = 0.45
        return replace(frame, image=np.full_like(frame.image, 90), depth_m=depth_m)

    tracks, _ = track([covered(f) if 15 <= k < 25 else f for k, f in enumerate(frames)])

    trusted = [k for k, step in enumerate(tracks) if step.node is not None and not step.doubts]
    assert not set(trusted) & set(range(15, 25))
    assert set(range(30, len(frames))) <= set(trusted)
    found = trajectory_from((tracks[k].stamp_ns, tracks[k].T_world_body) for k in trusted)
    assert ate_rmse_m(found, source.truth) < 0.01


@pytest.mark.parametrize(
    ("landmarks", "loose_m", "moving", "method"),
    [
        (20, 0.02, 0, "map+depth"),
        (40, 0.02, 0, "map"),
        (40, 0.0, 0, "map+depth"),
        (40, 0.0, 200, "map"),
        (200, 0.02, 0, "map"),
        (200, 0.0, 0, "map+depth"),
    ],
)
def test_depth_takes_part_where_landmarks_tell_too_little(
    frames, monkeypatch, landmarks, loose_m, moving, method
):
    """While something moves it does so only where they are few: surfaces can be those of passers-by."""
    monkeypatch.setattr(depth_tracker, "_LOOSE_M", loose_m)
    odometry = build_frame_odometry(LocalMapConfig())
    observations = [odometry.observe(frame) for frame in frames[:4]]
    for observation in observations[:3]:
        odometry.track(observation)
    last = odometry._last
    T_predicted = odometry._velocity.predicted(observations[3].stamp_ns, last)
    found = odometry._estimator._tracker.track(observations[3], last, T_predicted)
    kept = np.flatnonzero(found.landmark_of_feature >= 0)
    ids = np.full_like(found.landmark_of_feature, -1)
    spread = kept[np.linspace(0, len(kept) - 1, landmarks).astype(int)]
    ids[spread] = found.landmark_of_feature[spread]

    found = replace(found, landmark_of_feature=ids, moving=np.arange(moving, dtype=np.int32))
    supported = odometry._estimator._depth.supported(observations[3], last, T_predicted, found)

    assert supported.method == method
    assert (supported.depth is None) == (method == "map")


def test_a_relocalised_frame_is_not_aligned_to_itself(frames):
    """Its own surfaces would confirm any pose."""
    odometry = build_frame_odometry(LocalMapConfig())
    observations = [odometry.observe(frame) for frame in frames[:4]]
    for observation in observations[:3]:
        odometry.track(observation)
    last = odometry._last
    right = odometry._estimator._tracker.track(observations[3], last, None)
    found = replace(
        right,
        T_camera_world=exp(np.zeros(3), np.array([0.1, 0.0, 0.0])) @ right.T_camera_world,
        landmark_of_feature=np.full_like(right.landmark_of_feature, -1),
        method="relocalised",
    )

    supported = odometry._estimator._depth.supported(observations[3], found, None, found)

    assert supported.method == "relocalised+depth"
    error = inverse(right.T_camera_world) @ supported.T_camera_world
    assert np.linalg.norm(error[:3, 3]) < 0.02
