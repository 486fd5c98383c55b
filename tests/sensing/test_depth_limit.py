"""Which returns of a depth camera count, by their noise."""

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig
from mapper.sensing.depth_noise import DepthLimit, depth_sigma_m

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
