"""A road of which a sensor sees flat ground and guardrails: nothing shows the motion along it."""

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import TrackingError
from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.graph.model import PoseGraph
from mapper.odometry.scan_to_map.config import GicpOdometryConfig
from mapper.odometry.scan_to_map.gicp import GicpMatcher
from mapper.odometry.scan_to_map.odometry import ScanOdometry
from mapper.odometry.scan_to_map.scan_fit import fit_of
from mapper.pipeline.tracking_result import TrackingResult, refuse_a_fragment
from tests.support.room_scans import keyframe

INTERVAL_NS = 100_000_000


def road_scan(stamp_ns, *, seed, bushes_m=()):
    """Return rings of a sensor 1.8 m above a road with a rail at each side, and bushes from it."""
    rng = np.random.default_rng(seed)
    angle, azimuth = np.meshgrid(
        np.radians(np.arange(-15.0, 15.1, 2.0)), np.linspace(-np.pi, np.pi, 900, endpoint=False)
    )
    angle, azimuth = angle.ravel(), azimuth.ravel()
    with np.errstate(divide="ignore"):
        distances = np.where(angle < 0.0, -1.8 / np.tan(angle), np.inf)  # in plan
        to_rail = 6.0 / np.abs(np.sin(azimuth))
    height = to_rail * np.tan(angle)
    is_rail = (height > -1.32) & (height < -0.98)
    distances[is_rail] = np.minimum(distances, to_rail)[is_rail]
    for x, y in bushes_m:
        along = x * np.cos(azimuth) + y * np.sin(azimuth)
        depth = 1.2**2 - (x * np.sin(azimuth) - y * np.cos(azimuth)) ** 2
        is_hit = (depth > 0.0) & (along > 0.0)
        near = along - np.sqrt(np.maximum(depth, 0.0))
        distances[is_hit] = np.minimum(distances, near)[is_hit]
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(angle)], axis=1)
    ranges_m = distances + rng.normal(0.0, 0.02, len(distances))
    seen = ranges_m < 40.0
    return Scan(stamp_ns, (rays[seen] * ranges_m[seen, None]).astype(np.float32))


def tracks_along_the_road(count):
    config = GicpOdometryConfig()
    odometry = ScanOdometry(config, GicpMatcher(config))
    scans = [road_scan(k * INTERVAL_NS, seed=k) for k in range(count)]
    return [odometry.track(odometry.observe(scan)) for scan in scans]


def test_rings_that_move_with_the_sensor_do_not_show_that_it_stands():
    key, scan = (keyframe(road_scan(0, seed=seed), voxel_m=0.4) for seed in (1, 2))
    fit = fit_of(key, scan.deskewed, np.eye(4), max_pair_distance_m=0.5)
    assert "translation along x" in fit.unobservable
    assert fit.observability.min() == 0.0


def test_bushes_beside_the_road_show_the_motion():
    bushes_m = np.array([[6.0, 5.0], [-4.0, 8.0], [3.0, -7.0], [-9.0, -6.0]])
    key = keyframe(road_scan(0, seed=1, bushes_m=bushes_m), voxel_m=0.4)
    scan = keyframe(road_scan(0, seed=2, bushes_m=bushes_m - [1.0, 0.0]), voxel_m=0.4)
    right = exp(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    assert fit_of(key, scan.deskewed, right, max_pair_distance_m=0.5).observability.min() >= 1.0


def test_a_velocity_that_no_scan_told_is_unknown_and_so_is_the_way_it_goes():
    tracks = tracks_along_the_road(30)

    for track in tracks[1:]:
        assert any("translation along x" in doubt for doubt in track.doubts)
        assert any("its velocity is unknown" in doubt for doubt in track.doubts)
    sigmas_m = [np.sqrt(track.covariance[3, 3]) for track in tracks[1:]]
    assert sigmas_m[0] > 1.0  # within the first tenth of a second
    assert sigmas_m[-1] > 40.0  # in three seconds: a car drives 75 m
    assert np.all(np.diff(sigmas_m) > 0.0)
    assert np.sqrt(tracks[-1].covariance[5, 5]) < 0.6  # the road shows its height


def test_a_log_that_nothing_shows_the_motion_of_is_refused_with_the_remedy():
    tracks = tracks_along_the_road(10)
    tracking = TrackingResult(tuple(tracks), (), PoseGraph(), (), {})
    config = load_config(None, [], sensor="lidar")
    with pytest.raises(
        TrackingError, match=r"translation along x.* is not seen.*wheel odometry.*loops do not"
    ):
        refuse_a_fragment(tracking, config, sensor="lidar")
