"""A flat road with guardrails, whose scans are alike all along: they do not show that a sensor stands."""

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.odometry.scan_to_map.config import GicpOdometryConfig
from mapper.odometry.scan_to_map.gicp import GicpMatcher
from mapper.odometry.scan_to_map.odometry import ScanOdometry
from mapper.odometry.scan_to_map.scan_fit import fit_of
from tests.support.room_scans import keyframe

INTERVAL_NS = 100_000_000
SENSOR_M, RAIL_M = 1.8, 6.0  # height above the road, distance of the rails
HOUSES_M = (-11.0, -1.0, 9.0)  # along the road


def road_scan(stamp_ns, *, seed, across_m=0.0, has_houses=False):
    """Return 16 rings of a sensor that stands across_m left of the middle of the road."""
    rng = np.random.default_rng(seed)
    rings, azimuths = np.radians(np.arange(-15.0, 15.1, 2.0)), np.linspace(-np.pi, np.pi, 900, endpoint=False)
    angle, azimuth = (grid.ravel() for grid in np.meshgrid(rings, azimuths))
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(angle)], axis=1)  # 1 m long in plan
    with np.errstate(divide="ignore"):
        distances = np.where(angle < 0.0, -SENSOR_M / rays[:, 2], np.inf)
        to_rail = np.where(rays[:, 1] > 0.0, RAIL_M - across_m, RAIL_M + across_m) / np.abs(rays[:, 1])
    height = to_rail * rays[:, 2] + SENSOR_M
    is_rail = (height > 0.48) & (height < 0.82)
    distances[is_rail] = np.minimum(distances, to_rail)[is_rail]
    for x_m in HOUSES_M if has_houses else ():
        distances = np.minimum(distances, to_house(rays, x_m, across_m))
    ranges_m = distances + rng.normal(0.0, 0.02, len(distances))
    seen = ranges_m < 40.0
    return Scan(stamp_ns, (rays[seen] * ranges_m[seen, None]).astype(np.float32))


def to_house(rays, x_m, across_m):
    """Return the distances in plan, along rays, of two houses of 6 m beside the road."""
    nearest = np.full(len(rays), np.inf)
    for y_m in (11.0, -11.0):
        low, high = np.array([x_m - 3.0, y_m - across_m - 3.0]), np.array([x_m + 3.0, y_m - across_m + 3.0])
        with np.errstate(divide="ignore"):
            ends = np.stack([low / rays[:, :2], high / rays[:, :2]])
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        nearest = np.where((enter < leave) & (enter > 0.0), np.minimum(nearest, enter), nearest)
    return nearest


def fit_at(translation_m, *, is_velocity_known, **road):
    key = keyframe(road_scan(0, seed=1), voxel_m=0.4)
    scan = keyframe(road_scan(1, seed=2, **road), voxel_m=0.4).deskewed
    T_key_scan = exp(np.zeros(3), np.array(translation_m))
    fit = fit_of(key, scan, T_key_scan, max_pair_distance_m=0.5, is_velocity_known=is_velocity_known)
    assert fit is not None
    return fit


@pytest.mark.parametrize("is_velocity_known", [True, False])
def test_rings_that_move_with_the_sensor_do_not_show_that_it_stands(is_velocity_known):
    fit = fit_at([0.02, 0.0, 0.0], is_velocity_known=is_velocity_known)
    assert "translation along x" in fit.unobservable
    assert fit.observability.min() == 0.0


def test_nor_while_no_velocity_is_known_if_it_drifts_across_the_road():
    fit = fit_at([0.0, 0.25, 0.0], is_velocity_known=False, across_m=0.25)
    assert "translation along x" in fit.unobservable


def test_a_scan_from_farther_along_the_road_is_measured_as_before():
    known, unknown = (fit_at([0.3, 0.0, 0.0], is_velocity_known=is_known) for is_known in (True, False))
    np.testing.assert_array_equal(known.degeneracy.shares, unknown.degeneracy.shares)


def tracks(count, **road):
    config = GicpOdometryConfig()
    odometry = ScanOdometry(config, GicpMatcher(config))
    across_m = 0.3 * np.sin(0.04 * np.arange(count))
    scans = [road_scan(k * INTERVAL_NS, seed=k, across_m=across_m[k], **road) for k in range(count)]
    return [odometry.track(odometry.observe(scan)) for scan in scans]


def test_the_way_along_such_a_road_is_doubtful_from_the_first_scan_on():
    for track in tracks(40)[1:]:
        assert any("translation along x" in doubt.text and "unknown" in doubt.text for doubt in track.doubts)
        assert np.sqrt(track.covariance[3, 3]) > 1.0


def test_a_sensor_that_stands_between_houses_is_tracked():
    assert not any(track.doubts for track in tracks(12, has_houses=True))


def test_far_rings_have_the_normal_of_the_road():
    config = GicpOdometryConfig()
    deskewed = ScanOdometry(config, GicpMatcher(config)).observe(road_scan(0, seed=1)).deskewed
    assert deskewed is not None
    points, normals = deskewed.prepared.points, deskewed.prepared.normals
    distance_m = np.hypot(points[:, 0], points[:, 1])
    is_far = (points[:, 2] < 0.1 - SENSOR_M) & (distance_m > 8.0) & (distance_m < 12.0)
    assert is_far.sum() > 100
    assert np.degrees(np.median(np.arccos(np.minimum(normals[is_far, 2], 1.0)))) < 0.5
