import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.geometry import exp, inverse
from mapper.evaluators.metrics.map_quality import DistanceTo


def test_mean_and_median_are_those_of_every_distance_told_by_brute_force():
    rng = np.random.default_rng(0)
    target, source = rng.normal(size=(300, 3)), rng.normal(0.3, 1.0, size=(200, 3))
    nearest = np.linalg.norm(source[:, None] - target[None], axis=2).min(axis=1)

    distance = DistanceTo(target.astype(np.float32)).of(source.astype(np.float32), np.eye(4))

    assert distance.mhd_m == pytest.approx(nearest.mean(), abs=1e-6)
    assert distance.mpd_m == pytest.approx(np.median(nearest), abs=1e-6)


def test_a_moved_copy_is_at_no_distance_once_moved_back():
    target = np.random.default_rng(1).uniform(-20.0, 20.0, (5000, 3)).astype(np.float32)
    T_target_source = exp(np.array([0.1, -0.2, 1.0]), np.array([3.0, 1.0, -2.0]))
    T_source_target = inverse(T_target_source)
    source = (target @ T_source_target[:3, :3].T + T_source_target[:3, 3]).astype(np.float32)

    distance = DistanceTo(target).of(source, T_target_source)

    assert distance.mhd_m < 1e-5
    assert DistanceTo(target).of(source, np.eye(4)).mhd_m > 0.1


def test_it_is_not_symmetric_and_the_median_does_not_heed_what_only_one_saw():
    wall = np.random.default_rng(2).uniform(0.0, 5.0, (2000, 3)).astype(np.float32)
    with_car = np.concatenate([wall, wall[:400] + np.float32(50.0)])

    there, back = DistanceTo(wall).of(with_car, np.eye(4)), DistanceTo(with_car).of(wall, np.eye(4))

    assert back.mhd_m == back.mpd_m == 0.0
    assert there.mhd_m > 5.0
    assert there.mpd_m == 0.0


def test_an_empty_cloud_on_either_side_is_an_error():
    points, none = np.ones((5, 3), np.float32), np.empty((0, 3), np.float32)
    with pytest.raises(DataError, match="no points"):
        DistanceTo(none)
    with pytest.raises(DataError, match="the source has no points"):
        DistanceTo(points).of(none, np.eye(4))
