"""Poses after a gap: another place that looks alike is not taken."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.odometry.base import ANOTHER_PLACE
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry

NOW = 42
AFTER_NS = 3_000_000_000


@pytest.fixture
def odometry(frames):
    odometry = build_frame_odometry(LocalMapConfig())
    for frame in frames[:NOW]:
        odometry.track(odometry.observe(frame))
    return odometry


def later(pose, by_ns):
    return replace(pose, observation=replace(pose.observation, stamp_ns=pose.stamp_ns + by_ns))


def with_a_corner_alone(pose):
    """Return a pose whose inliers are those on one part of what is in view, as on a poster."""
    ids = pose.landmark_of_feature.copy()
    found = np.flatnonzero(ids >= 0)
    pixels = pose.observation.pixels[found]
    middle = np.median(pixels, axis=0)
    nearest = np.argsort(np.linalg.norm(pixels - middle, axis=1))[:40]
    ids[np.setdiff1d(found, found[nearest])] = -1
    return replace(pose, landmark_of_feature=ids)


def test_after_a_gap_landmarks_have_to_agree_all_over_the_view(odometry):
    check, last = odometry._estimator._gap_check, odometry._last
    right = later(last, AFTER_NS)
    assert not check.is_contradicted(right, last)
    assert check.is_contradicted(with_a_corner_alone(right), last)


def test_a_pose_soon_after_the_last_one_may_rest_on_a_part_of_the_view(odometry):
    check, last = odometry._estimator._gap_check, odometry._last
    assert not check.is_contradicted(with_a_corner_alone(later(last, 500_000_000)), last)


def test_few_landmarks_spread_over_the_view_are_enough(odometry):
    check, last = odometry._estimator._gap_check, odometry._last
    ids = last.landmark_of_feature.copy()
    found = np.flatnonzero(ids >= 0)
    ids[np.setdiff1d(found, np.random.default_rng(1).choice(found, 40, replace=False))] = -1
    assert not check.is_contradicted(later(replace(last, landmark_of_feature=ids), AFTER_NS), last)


def test_a_place_ten_metres_away_takes_more_than_three_seconds(odometry):
    check, last = odometry._estimator._gap_check, odometry._last
    T_away = exp(np.zeros(3), np.array([10.0, 0.0, 0.0]))
    away = replace(last, T_camera_world=T_away @ last.T_camera_world)
    assert check.is_out_of_reach(later(away, AFTER_NS), last, 0.3)
    assert not check.is_out_of_reach(later(away, AFTER_NS), last, 1.5)  # the log is of a fast sensor
    assert not check.is_out_of_reach(later(away, 3 * AFTER_NS), last, 0.3)


def with_a_copy_of_all_places(odometry, shift_m):
    """Add all keyframes to the map once more, some metres away, as if the rooms there looked alike."""
    landmark_map, T_shift = odometry._map, exp(np.zeros(3), np.array([shift_m, 0.0, 0.0]))
    for k in range(len(landmark_map.keyframes)):
        seen = landmark_map.observation(k)
        copy = landmark_map.add_keyframe(
            seen,
            landmark_map.keyframes[k].T_camera_world @ T_shift,
            np.full(len(seen), -1, np.int32),
            new=seen.has_depth,
            neighbour=k,
            twist_camera=np.zeros(6),
        )
        odometry._estimator._relocalizer.add(copy)


@pytest.mark.parametrize(
    ("shift_m", "after_ns", "kinds"),
    [(3.0, AFTER_NS, [ANOTHER_PLACE]), (3.0, 500_000_000, []), (0.1, AFTER_NS, []), (None, AFTER_NS, [])],
    ids=["alike, after a gap", "alike, without a gap", "one place, after drift", "one place"],
)
def test_after_a_gap_a_view_that_fits_two_places_is_doubtful(odometry, frames, shift_m, after_ns, kinds):
    if shift_m is not None:
        with_a_copy_of_all_places(odometry, shift_m)
    frame = replace(frames[NOW], stamp_ns=frames[NOW - 1].stamp_ns + after_ns)
    result = odometry.track(odometry.observe(frame))
    assert [doubt.kind for doubt in result.doubts if doubt.kind == ANOTHER_PLACE] == kinds
    assert result.node is not None


def test_a_frame_after_a_gap_that_a_poster_alone_places_is_lost(odometry, frames, monkeypatch):
    observation = odometry.observe(replace(frames[NOW], stamp_ns=frames[NOW].stamp_ns + AFTER_NS))
    alone = with_a_corner_alone(odometry._last)
    estimator = odometry._estimator
    monkeypatch.setattr(estimator._tracker, "track", lambda *_: replace(alone, observation=observation))
    monkeypatch.setattr(estimator._depth, "supported", lambda *arguments: arguments[-1])
    monkeypatch.setattr(estimator._relocalizer, "candidates", lambda *_: [])
    assert odometry.track(observation).node is None


def seen_otherwise(pose, by_ns, change):
    """Return a later pose whose image and depth are changed, ``change(grey, inverse_depth)``."""
    observation = pose.observation
    grey, inverse_depth = change(observation.grey_cells, observation.depth_cells.inverse_depth)
    cells = replace(observation.depth_cells, inverse_depth=inverse_depth)
    changed = replace(observation, grey_cells=grey, depth_cells=cells)
    return later(replace(pose, observation=changed), by_ns)


@pytest.mark.parametrize(
    ("change", "is_different"),
    [
        (lambda grey, inverse_depth: (grey, inverse_depth), False),
        (lambda grey, inverse_depth: ((0.4 * grey + 30.0).astype(np.uint8), inverse_depth), False),
        (lambda grey, inverse_depth: (np.flip(grey).copy(), inverse_depth), True),
        (lambda grey, inverse_depth: (grey, 2.0 * inverse_depth), True),
    ],
    ids=["the same view", "in other light", "another picture", "nearer surfaces"],
)
def test_after_a_gap_the_images_between_the_features_have_to_agree(odometry, change, is_different):
    check, last = odometry._estimator._gap_check, odometry._last
    assert check.is_contradicted(seen_otherwise(last, AFTER_NS, change), last) == is_different
    assert not check.is_contradicted(seen_otherwise(last, 500_000_000, change), last)


def test_a_frame_after_a_gap_whose_image_is_of_another_place_is_lost(odometry, frames, monkeypatch):
    observation = odometry.observe(replace(frames[NOW], stamp_ns=frames[NOW].stamp_ns + AFTER_NS))
    changed = replace(observation, grey_cells=np.flip(observation.grey_cells).copy())
    estimator = odometry._estimator
    monkeypatch.setattr(estimator._tracker, "track", lambda *_: replace(odometry._last, observation=changed))
    monkeypatch.setattr(estimator._depth, "supported", lambda *arguments: arguments[-1])
    monkeypatch.setattr(estimator._relocalizer, "candidates", lambda *_: [])
    assert odometry.track(changed).node is None
