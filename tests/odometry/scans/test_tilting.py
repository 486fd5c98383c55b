"""Scans of a sensor that tilts or sees little, whose last keyframe soon shows another part of the scene."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.geometry import inverse
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from tests.support.logs import memory_entry
from tests.support.paths import DATA


def test_a_rolling_sensor_is_followed():
    settings = {"seed": 82, "duration_s": 2.0, "tilt_rad": 0.52, "sensor": LidarSensorConfig(rings=32)}
    log = LidarSimulator(STREET.model_copy(update=settings)).log()
    odometry = build_frame_odometry(GicpOdometryConfig())

    results = [odometry.track(odometry.observe(entry.load())) for entry in log.entries()]

    assert all(result.node is not None for result in results)
    assert not any(result.doubts for result in results)
    assert [result.stamp_ns for result in results] == log.truth.stamps_ns.tolist()
    for result, T_world_body in zip(results, log.truth.T_world_body, strict=True):
        error = inverse(inverse(log.truth.T_world_body[0]) @ T_world_body) @ result.T_world_body
        assert np.linalg.norm(error[:3, 3]) < 0.12


def test_a_real_sensor_by_hand_that_sees_a_part_of_the_scene_is_followed():
    if not (DATA / "courtyard_2hz").exists():
        pytest.skip("no courtyard_2hz")
    log = open_source(DATA / "courtyard_2hz", SourceConfig(first_frame=30, last_frame=59))
    scans = [entry.scan() for entry in log.entries()]
    seen = [scan.select(are_ahead(scan.points_body)) for scan in scans]
    entries = [memory_entry(int(at), scan) for at, scan in zip(log.stamps_ns, seen, strict=True)]
    config = load_config(None, ["loops.kind=none"], sensor="lidar")

    tracking = track_log(replace(log, entry_at=entries.__getitem__), config, progress=SILENT)

    assert len(tracking.tracked) == len(entries)
    assert not any(track.doubts for track in tracking.tracks)
    assert ate_rmse_m(tracking.trajectory(), log.truth) < 0.06


def are_ahead(points):
    """Return the mask of the points within 120° of straight ahead."""
    return np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.radians(120.0)
