"""Depth noise of a sensor in the settings, and its effect on the odometry."""

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import ConfigError
from mapper.core.frames import RgbdFrame, Scan
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig
from mapper.sensing.depth import DepthLimit, depth_sigma_m, feature_depth_sigma_m
from mapper.simulation.config import SynthConfig
from mapper.simulation.source import CameraSimulator

NOISE = DepthNoiseConfig(constant_m=0.002, linear=-0.001, quadratic_per_m=0.003)
TINY = DepthNoiseConfig(constant_m=1e-9)


def test_the_model_is_a_parabola_and_can_be_read():
    np.testing.assert_allclose(depth_sigma_m(NOISE, np.array([0.5, 2.0])), [0.00225, 0.012])
    assert NOISE.text == "0.002 − 0.001·z + 0.003·z²"
    assert DepthNoiseConfig(quadratic_per_m=0.0019).text == "0.0019·z²"


@pytest.mark.parametrize("text", ["linear=-0.1", "constant_m=0"])
def test_noise_that_vanishes_at_some_depth_is_refused(text):
    with pytest.raises(ConfigError, match=r"depth_noise: .*is not > 0 at every depth"):
        load_config(None, [f"odometry.depth_noise.{text}"])


def test_a_noise_that_touches_zero_is_refused_and_one_just_above_is_not():
    with pytest.raises(ValueError, match="not > 0"):
        DepthNoiseConfig(constant_m=0.01, linear=-0.02, quadratic_per_m=0.01)
    DepthNoiseConfig(constant_m=0.01, linear=-0.0199, quadratic_per_m=0.01)


def sigmas_m(depth_m, pixels, sigma_px, noise):
    columns, rows = np.array(pixels).T
    return feature_depth_sigma_m(
        depth_m.astype(np.float32), columns, rows, sigma_px=np.array(sigma_px), noise=noise
    )


def test_on_a_wall_across_the_axis_there_is_only_noise():
    wall_m = np.full((20, 30), 2.0)
    wall_m[3, 6] = 0.0
    found = sigmas_m(wall_m, [(5, 3), (29, 19), (0, 0)], [1.0, 2.4, 3.0], NOISE)
    np.testing.assert_allclose(found, 0.012, rtol=1e-6)


def test_a_slope_counts_by_how_uncertain_the_pixel_is():
    columns, rows = np.meshgrid(np.arange(40), np.arange(30))
    slope_m = 1.0 + 0.003 * columns + 0.004 * rows
    found = sigmas_m(slope_m, [(20, 15)] * 3, [1.0, 1.44, 3.0], TINY)
    np.testing.assert_allclose(found, 0.005 * np.array([1.0, 1.44, 3.0]), rtol=1e-4)
    with_noise = sigmas_m(np.full((30, 40), 2.0) + 0.005 * columns, [(20, 15)], [1.0], NOISE)
    np.testing.assert_allclose(with_noise, np.hypot(depth_sigma_m(NOISE, np.array([2.1])), 0.005), rtol=1e-4)


def test_beside_an_edge_the_depth_is_uncertain():
    edge_m = np.full((20, 30), 1.0)
    edge_m[:, 15:] = 3.0
    beside, away = sigmas_m(edge_m, [(14, 10), (5, 10)], [1.0, 1.0], NOISE)
    assert beside > 0.4
    assert away == pytest.approx(0.004)


def test_the_odometry_weighs_by_it_and_by_nothing_without_it():
    frame = next(
        CameraSimulator(SynthConfig(width_px=320, height_px=240, texture_px_per_m=96)).log().entries()
    ).load()
    wall_m = np.full_like(frame.depth_m, 2.0)
    wall_m[:120] = 0.0
    frame = RgbdFrame(frame.stamp_ns, frame.image, wall_m, frame.camera)
    usual, known = (
        build_frame_odometry(LocalMapConfig(depth_noise=noise)).observe(frame) for noise in (None, NOISE)
    )
    np.testing.assert_allclose(usual.weights[:, 2] ** -0.5, usual.weights[:, 0] ** -0.5)
    np.testing.assert_array_equal(known.weights[:, :2], usual.weights[:, :2])
    np.testing.assert_array_equal(known.measured, usual.measured)
    near = known.has_depth
    assert 100 < near.sum() < len(known)
    np.testing.assert_allclose(known.weights[near, 2] ** -0.5, 40.0 / 4.0 * 0.012, rtol=1e-6)
    np.testing.assert_array_equal(known.weights[~near, 2], usual.weights[~near, 2])


RAY = (0.31, -0.11, 1.0)
STEREO = DepthNoiseConfig(quadratic_per_m=0.005)


def scan_at(*depths_m, origin=(0.0, 0.0, 0.0)):
    points = [(0.31 * z + origin[0], -0.11 * z + origin[1], z + origin[2]) for z in depths_m]
    colors = np.arange(3 * len(depths_m), dtype=np.uint8).reshape(-1, 3)
    return Scan(7, np.array(points, np.float32), np.array(origin), colors)


@pytest.mark.parametrize(
    "noise",
    [KINECT_NOISE, STEREO, DepthNoiseConfig(constant_m=0.01, linear=0.004)],
    ids=lambda noise: noise.text,
)
@pytest.mark.parametrize("voxel_m", [0.02, 0.05, 0.2])
def test_at_the_limit_the_noise_is_a_voxel(noise, voxel_m):
    depth_m = DepthLimit(noise, max_sigma_m=voxel_m).depth_m
    assert depth_sigma_m(noise, np.array([depth_m]))[0] == pytest.approx(voxel_m)


def test_noise_above_a_voxel_leaves_nothing_and_noise_below_it_all():
    assert DepthLimit(DepthNoiseConfig(constant_m=0.06), max_sigma_m=0.05).depth_m == 0.0
    assert DepthLimit(DepthNoiseConfig(constant_m=0.04), max_sigma_m=0.05).depth_m == 100.0


def test_far_returns_free_space_up_to_two_sigmas_before_them():
    limit = DepthLimit(STEREO, max_sigma_m=0.05)  # 3.16 m
    scan = scan_at(1.0, 3.1, 3.2, 20.0, 99.0, 150.0, origin=(0.5, 0.0, 0.1))

    counting, free_ends = limit.split(scan)

    np.testing.assert_array_equal(counting.points_body, scan.points_body[:2])
    np.testing.assert_array_equal(counting.colors, scan.colors[:2])
    assert counting.stamp_ns == 7
    # 3.2 m: σ is 51 mm; 20 m: σ is 2 m; 99 m: σ is 49 m; 150 m: σ is 112 m, so that nothing is known.
    stops_m = [3.2 - 0.1024, limit.depth_m, 99.0 - 98.01]
    rays = np.array(RAY)
    np.testing.assert_allclose(free_ends, np.outer(stops_m, rays) + scan.origin_body, rtol=1e-5)


def test_a_scan_within_the_limit_is_left_as_it_is():
    scan = scan_at(0.5, 3.0)
    counting, free_ends = DepthLimit(STEREO, max_sigma_m=0.05).split(scan)
    assert counting is scan
    assert free_ends.shape == (0, 3)


@pytest.mark.parametrize("discretize", [True, False])
def test_the_octree_has_no_obstacle_where_depth_is_poor_but_free_space_before_it(discretize):
    config = OctreeConfig(depth_noise=STEREO, discretize=discretize)
    octree = OctreeMap(config)
    octree.insert(scan_at(2.02, 20.02), np.eye(4))

    along = np.array(RAY)
    depths_m = [2.02], [2.5, 2.7, 2.9], [3.3, 20.02]
    at, free, beyond = (octree.log_odds_at(np.outer(z, along)) for z in depths_m)
    assert at[0] > 0.0
    assert np.nanmax(free) < 0.0
    assert np.isnan(beyond).all()

    fixed = OctreeMap(config.model_copy(update={"max_range_m": 30.0}))  # a number replaces the noise
    fixed.insert(scan_at(2.02, 20.02), np.eye(4))
    assert fixed.log_odds_at(20.02 * along[np.newaxis])[0] > 0.0


def test_colours_are_kept_of_returns_that_count_alone():
    octree = OctreeMap(OctreeConfig(depth_noise=STEREO, attributes=True))
    octree.insert(scan_at(2.02, 20.02), np.eye(4))
    attributes = octree.attributes.at(np.outer([2.02, 20.02], RAY))
    assert attributes.hits.tolist() == [1, 0]
