"""The default odometry where images show little: depth continues the path, or says what it does not show."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from tests.support.depth_rooms import CORNER, white_frame

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


def test_without_the_depth_leg_it_is_lost():
    tracks, _ = track(walk(swaying()[:4], ROOM), align_depth=False)
    assert all(step.node is None for step in tracks)


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
