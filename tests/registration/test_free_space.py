"""Free-space check: points on surfaces agree, those before them contradict, hidden ones do neither."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse
from mapper.registration.free_space import FreeSpaceCheck, ScanDescription, range_image

DIRECTION_RAD = 0.02
WALL_M = 10.0


def wall(distance_m):
    """A wall ahead, 6 m wide and 4 m high."""
    y, z = np.meshgrid(np.linspace(-3.0, 3.0, 121), np.linspace(-2.0, 2.0, 81))
    return np.column_stack([np.full(y.size, distance_m), y.ravel(), z.ravel()]).astype(np.float32)


def description(points, T_level_body=None, origin_body=None):
    T_level_body = np.eye(4) if T_level_body is None else T_level_body
    origin_body = np.zeros(3) if origin_body is None else origin_body
    obstacles = (points @ T_level_body[:3, :3].T + T_level_body[:3, 3]).astype(np.float32)
    ranges_m = range_image(points, origin_body, DIRECTION_RAD)
    return ScanDescription(T_level_body, obstacles, ranges_m, DIRECTION_RAD, origin_body)


@pytest.mark.parametrize(
    ("at_m", "agreeing", "contradicting"), [(10.2, 1, 0), (9.8, 1, 0), (5.0, 0, 1), (15.0, 0, 0)]
)
def test_a_point_on_before_and_behind_a_wall(at_m, agreeing, contradicting):
    point = np.array([[at_m, 0.0, 0.0]], np.float32)
    counts = FreeSpaceCheck(0.3).count(description(wall(WALL_M)), point, np.eye(4))
    assert (counts.points, counts.agreeing, counts.contradicting) == (1, agreeing, contradicting)
    assert counts.visible == agreeing + contradicting


def test_where_no_ray_went_nothing_contradicts():
    beside = np.array([[0.0, 5.0, 0.0], [-5.0, 0.0, 0.0], [0.0, 0.0, 5.0]], np.float32)
    counts = FreeSpaceCheck(0.3).count(description(wall(WALL_M)), beside, np.eye(4))
    assert counts.visible == 0
    assert counts.agreeing_ratio == counts.visible_contradicting_ratio == 0.0


def test_the_margin_grows_with_the_range():
    near, far = (description(wall(distance_m)) for distance_m in (5.0, 20.0))
    check = FreeSpaceCheck(0.1)
    for scan, distance_m, agreeing in ((near, 5.0, 0), (far, 20.0, 1)):
        point = np.array([[distance_m - 0.25, 0.0, 0.0]], np.float32)
        assert check.count(scan, point, np.eye(4)).agreeing == agreeing


def test_both_scans_are_compared_under_the_motion_whatever_their_level_frames_and_origins():
    T_target_source = exp(np.array([0.0, 0.0, 0.2]), np.array([3.0, 0.5, 0.0]))
    T_source_target = inverse(T_target_source)
    seen_by_source = wall(WALL_M).astype(np.float64) @ T_source_target[:3, :3].T + T_source_target[:3, 3]
    target = description(wall(WALL_M), T_level_body=exp(np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 1.7])))
    source = description(seen_by_source.astype(np.float32), origin_body=np.array([0.2, 0.0, 0.0]))

    right = FreeSpaceCheck(0.3).compare(target, source, T_target_source)
    assert min(right.source.agreeing_ratio, right.target.agreeing_ratio) == 1.0

    wrong = FreeSpaceCheck(0.3).compare(
        target, source, T_target_source @ exp(np.zeros(3), np.array([-4.0, 0, 0]))
    )
    assert wrong.source.visible_contradicting_ratio == 1.0
    assert wrong.source.contradicting_ratio > 0.36  # nearer by 4 m, the wall is wider than the rays on it
    assert wrong.target.agreeing == 0
