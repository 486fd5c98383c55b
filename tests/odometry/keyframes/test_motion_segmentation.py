"""The camera's motion among others: a passer-by with most of the features does not lead."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import Points, Transform, apply, exp, inverse, log
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.keyframes.motion_segmentation import CameraMotion, camera_motion
from mapper.odometry.keyframes.pose_tracker import project

T_CAMERA_WORLD = exp(np.array([0.0, 0.01, 0.0]), np.array([0.02, 0.0, 0.01]))
T_WALKED = exp(np.zeros(3), np.array([0.1, 0.1, 0.0]))


@pytest.fixture
def observation(frames):
    """Any frame: its pixels are replaced."""
    return build_frame_odometry(LocalMapConfig()).observe(frames[0])


def room(count: int, rng: np.random.Generator) -> Points:
    """Return points on a far wall and on the floor."""
    points = rng.uniform((-3.0, -1.0, 3.0), (3.0, 1.2, 6.0), (count, 3))
    points[::2, 2] = 6.0
    points[1::2, 1] = 1.2
    return points


def person(count: int, rng: np.random.Generator) -> Points:
    """Return points on somebody two metres away."""
    return rng.uniform((-0.3, -0.7, 2.0), (0.3, 0.9, 2.0), (count, 3))


def motion_of(
    observation,
    rng,
    *,
    still: Points,
    moved: Points,
    observers: tuple[int, int],
    T_moved: Transform = T_WALKED,
) -> CameraMotion:
    """Return the motion from points that stand still and others that moved, each seen so often."""
    points = np.concatenate([still, moved])
    now = np.concatenate([still, apply(T_moved, moved)])
    z = apply(T_CAMERA_WORLD, now)[:, 2]
    pixels = project(T_CAMERA_WORLD, now, observation.intrinsics) + 0.3 * rng.standard_normal((len(now), 2))
    measured = np.column_stack([pixels, observation.intrinsics[4] / z])
    observation = replace(
        observation, measured=measured, weights=np.ones((len(now), 3)), sensor_weights=np.ones((len(now), 3))
    )
    counts = np.repeat(observers, [len(still), len(moved)])
    return camera_motion(
        np.eye(4), points, observation, np.arange(len(points)), counts, observation.sensor_weights
    )


def miss_m(motion: CameraMotion) -> float:
    return float(np.linalg.norm(log(motion.T_camera_world @ inverse(T_CAMERA_WORLD))[1]))


@pytest.mark.parametrize(("count", "observers"), [(250, (3, 0)), (60, (0, 0))], ids=["most", "no map"])
def test_a_person_does_not_lead(observation, count, observers):
    rng = np.random.default_rng(1)
    motion = motion_of(observation, rng, still=room(100, rng), moved=person(count, rng), observers=observers)
    assert miss_m(motion) < 0.02
    assert motion.agree[:100].mean() > 0.9
    assert motion.moving[100:].mean() > 0.9
    assert motion.agree[100:].mean() < 0.1


def test_mismatches_are_no_other_motion(observation):
    rng = np.random.default_rng(2)
    motion = motion_of(observation, rng, still=room(200, rng), moved=room(1, rng), observers=(2, 0))
    points = room(230, rng)
    pixels = project(T_CAMERA_WORLD, points, observation.intrinsics)
    pixels[200:] += rng.uniform(10.0, 60.0, (30, 2)) * rng.choice([-1.0, 1.0], (30, 2))
    disparity = observation.intrinsics[4] / apply(T_CAMERA_WORLD, points)[:, 2]
    mixed = replace(
        observation,
        measured=np.column_stack([pixels, disparity]),
        weights=np.ones((230, 3)),
        sensor_weights=np.ones((230, 3)),
    )
    motion = camera_motion(np.eye(4), points, mixed, np.arange(230), np.full(230, 2), mixed.weights)
    assert miss_m(motion) < 0.01
    assert not motion.moving.any()
    assert not motion.doubts


def test_two_motions_of_half_the_scene_each_are_doubtful(observation):
    rng = np.random.default_rng(3)
    T_moved = exp(np.array([0.0, 0.02, 0.0]), np.array([0.0, 0.3, 0.0]))
    motion = motion_of(
        observation, rng, still=room(120, rng), moved=room(100, rng), observers=(0, 0), T_moved=T_moved
    )
    assert [doubt.kind for doubt in motion.doubts] == ["disagreement"]


def test_features_that_move_become_no_landmarks(frames):
    odometry = build_frame_odometry(LocalMapConfig())
    odometry.track(odometry.observe(frames[0]))
    pose = odometry._last
    with_depth = np.flatnonzero(pose.observation.has_depth).astype(np.int32)
    moving, still = with_depth[:20], with_depth[20:]
    pose = replace(pose, landmark_of_feature=np.full(len(pose.observation), -1, np.int32), moving=moving)
    landmarks = odometry._mapping.add_keyframe(
        pose, neighbour=0, twist_camera=np.zeros(6)
    ).landmark_of_feature
    assert (landmarks[moving] < 0).all()
    assert (landmarks[still] >= 0).all()
