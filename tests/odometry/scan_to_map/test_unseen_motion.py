"""Motions that hardly any surface shows: along tunnels and fields, and while no velocity is known."""

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import TrackingError
from mapper.core.frames import Scan
from mapper.core.geometry import inverse
from mapper.graph.model import PoseGraph
from mapper.odometry.scan_to_map.config import GicpOdometryConfig
from mapper.odometry.scan_to_map.gicp import GicpMatcher
from mapper.odometry.scan_to_map.odometry import ScanOdometry
from mapper.pipeline.tracking_result import TrackingResult, refuse_a_fragment
from mapper.simulation.config import LIDAR_SCENES, LidarSensorConfig
from mapper.simulation.lidar import make_outdoor_scene
from tests.support.street_scans import on_street, still_scan

INTERVAL_NS = 100_000_000


def tunnel_scan(stamp_ns, *, seed, x_m=0.0, rough_m=0.0):
    """Return what is seen from a place in a tunnel whose walls are bare, or rough by so much."""
    rng = np.random.default_rng(seed)
    along, angle = rng.uniform(-25.0, 25.0, 12000), rng.uniform(0.0, 2.0 * np.pi, 12000)
    corners = np.clip(np.stack([np.cos(angle), np.sin(angle)]) * 6.0, -4.0, 4.0)
    phases = 1.9 * (along + x_m), 3.1 * (along + x_m) + 4.0 * angle
    corners *= 1.0 + rough_m / 4.0 * (np.sin(phases[0]) + np.sin(phases[1]))
    points = np.column_stack([along, *corners]) + rng.normal(0.0, 0.01, (12000, 3))
    return Scan(stamp_ns, points.astype(np.float32))


def tracks_along_the_tunnel(count):
    config = GicpOdometryConfig()
    odometry = ScanOdometry(config, GicpMatcher(config))
    scans = [tunnel_scan(k * INTERVAL_NS, seed=k) for k in range(count)]
    return [odometry.track(odometry.observe(scan)) for scan in scans]


def test_a_velocity_that_no_scan_showed_is_unknown_and_so_is_the_way_it_goes():
    tracks = tracks_along_the_tunnel(30)

    for track in tracks[1:]:
        assert any("translation along x" in doubt.text for doubt in track.doubts)
        assert any("its velocity is unknown" in doubt.text for doubt in track.doubts)
    sigmas_m = [np.sqrt(track.covariance[3, 3]) for track in tracks[1:]]
    assert sigmas_m[0] > 1.0  # within the first tenth of a second
    assert sigmas_m[-1] > 30.0  # in three seconds
    assert np.all(np.diff(sigmas_m) > 0.0)
    assert np.sqrt(tracks[-1].covariance[5, 5]) < 0.6  # the tunnel shows its height


def test_rough_walls_show_the_motion_though_none_faces_it():
    config = GicpOdometryConfig()
    odometry = ScanOdometry(config, GicpMatcher(config))
    places_m = np.arange(20) * 0.1
    scans = [
        tunnel_scan(k * INTERVAL_NS, seed=k, x_m=x_m, rough_m=0.1) for k, x_m in enumerate(places_m.tolist())
    ]
    tracks = [odometry.track(odometry.observe(scan)) for scan in scans]

    doubtful = [track for track in tracks if track.doubts]
    assert len(doubtful) < 6  # nearer than a voxel to the first scan
    assert not any(track.doubts for track in tracks[6:])
    assert tracks[-1].T_world_body[0, 3] == pytest.approx(places_m[-1], abs=0.05)


def test_a_log_may_begin_at_83_kilometres_an_hour_among_few_trees():
    scene = make_outdoor_scene(LIDAR_SCENES["field"].model_copy(update={"seed": 3}))
    sensor = LidarSensorConfig(rings=32, azimuth_steps=720)
    places = [on_street(scene, 20.0 + 2.3 * k) for k in range(4)]
    config = GicpOdometryConfig()
    odometry = ScanOdometry(config, GicpMatcher(config))
    for k, T_world_body in enumerate(places):
        scan = Scan(k * INTERVAL_NS, still_scan(scene, sensor, T_world_body, seed=k))
        track = odometry.track(odometry.observe(scan))
        error = inverse(track.T_world_body) @ inverse(places[0]) @ T_world_body
        assert np.linalg.norm(error[:3, 3]) < 0.15
        assert not track.doubts


def test_a_log_that_nothing_shows_the_motion_of_is_refused_with_the_remedy():
    tracks = tracks_along_the_tunnel(10)
    tracking = TrackingResult(tuple(tracks), (), PoseGraph(), (), {})
    config = load_config(None, [], sensor="lidar")
    with pytest.raises(
        TrackingError, match=r"translation along x.* is not seen.*wheel odometry.*loops do not"
    ):
        refuse_a_fragment(tracking, config, sensor="lidar")
