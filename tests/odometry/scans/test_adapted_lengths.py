"""Lengths of the scan odometries in narrow and wide surroundings."""

from pathlib import Path

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.frames import Scan
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.scans.adapted_lengths import adapted_to, spaciousness_m
from mapper.odometry.scans.config import GicpOdometryConfig, IcpOdometryConfig
from mapper.sources.base import Log
from tests.support.paths import ROOT


class Cube:
    """A scan of the inside of a cube."""

    def __init__(self, stamp_ns, half_m):
        rng = np.random.default_rng(stamp_ns)
        points = rng.uniform(-half_m, half_m, (4000, 3))
        points[np.arange(4000), rng.integers(0, 3, 4000)] = half_m * rng.choice([-1.0, 1.0], 4000)
        self.stamp_ns = stamp_ns
        self.cloud = Scan(stamp_ns, points.astype(np.float32))

    def scan(self):
        return self.cloud


def log_of(*halves_m):
    entries = [Cube(k, half_m) for k, half_m in enumerate(halves_m)]
    stamps_ns = np.arange(len(entries), dtype=np.int64)
    return Log(
        path=Path("log"),
        name="log",
        kind="kitti",
        sensor="lidar",
        stamps_ns=stamps_ns,
        entry_at=lambda index: entries[index],
    )


def test_the_ground_next_to_the_sensor_does_not_make_a_place_narrow():
    rng = np.random.default_rng(0)
    near, far = rng.uniform(-1.0, 1.0, (9000, 3)), Cube(0, 20.0).cloud.points_body
    scan = Scan(0, np.concatenate([near, far]).astype(np.float32))

    assert spaciousness_m(scan) > 20.0


def test_rooms_have_smaller_lengths_and_streets_those_of_the_settings():
    config = GicpOdometryConfig()

    assert adapted_to(config, log_of(20.0)) is config
    log = log_of(3.0, 3.0, 3.0)
    room = adapted_to(config, log)
    assert 0.15 <= room.voxel_m < 0.3
    for name in ("cell_m", "coarse_cell_m", "keyframe_distance_m", "max_pair_distance_m"):
        assert getattr(room, name) / getattr(config, name) == pytest.approx(room.voxel_m / config.voxel_m)
    assert (room.min_range_m, room.max_range_m) == (config.min_range_m, config.max_range_m)
    again = adapted_to(room.model_copy(update={"scale": None}), log)
    assert again.voxel_m == pytest.approx(room.voxel_m)


def test_a_log_that_is_mostly_out_of_doors_is_not_a_room():
    config = GicpOdometryConfig()

    assert adapted_to(config, log_of(3.0, *[15.0] * 8)) is config


def test_a_set_scale_holds_in_every_place():
    icp = adapted_to(IcpOdometryConfig(scale=0.5), log_of(20.0))
    assert icp.pair_distances_m == (1.0, 0.5, 0.25)
    assert icp.voxel_m == 0.2
    assert adapted_to(GicpOdometryConfig(scale=1.0), log_of(1.0)).voxel_m == 0.4


def test_settings_for_rooms_and_other_odometries_stay_as_they_are():
    indoor = load_config(ROOT / "configs/lidar_indoor.toml", [], sensor="lidar").odometry

    assert adapted_to(indoor, log_of(1.0)) == indoor
    assert adapted_to(LocalMapConfig(), log_of(1.0)) == LocalMapConfig()
