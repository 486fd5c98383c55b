"""The policy for things that move: OctoMap's map but for voxels that were seen through."""

import numpy as np

from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap

ORIGIN = np.array([0.025, 0.025, 0.025])
NEAR, FAR = (np.array([[x, 0.025, 0.025]], np.float32) for x in (1.025, 2.025))


def random_map(config, *, seed):
    rng, octree = np.random.default_rng(seed), OctreeMap(config)
    for _ in range(12):
        octree.insert_points(rng.normal(0.0, 0.6, (80, 3)).astype(np.float32), rng.normal(0.0, 0.1, 3))
    return octree


def log_odds_after(scans, config):
    octree = OctreeMap(config)
    for points in scans:
        octree.insert_points(points, ORIGIN)
    return float(octree.query(NEAR.astype(np.float64))[0])


def test_while_no_run_is_long_enough_the_map_is_octomap_s():
    for seed in range(3):
        plain = random_map(OctreeConfig(), seed=seed).leaves()
        policy = random_map(OctreeConfig(dynamic="seen-through", seen_through_scans=13), seed=seed).leaves()
        np.testing.assert_array_equal(plain.keys, policy.keys)
        np.testing.assert_array_equal(plain.log_odds.view(np.int32), policy.log_odds.view(np.int32))


def test_a_voxel_is_released_by_a_run_of_scans_in_which_it_is_free():
    config = OctreeConfig(dynamic="seen-through", seen_through_scans=3)
    miss = np.log(0.4 / 0.6)

    assert log_odds_after([NEAR] * 20 + [FAR] * 2, config) > 2.0
    assert np.isclose(log_odds_after([NEAR] * 20 + [FAR] * 3, config), max(3 * miss, np.log(0.1192 / 0.8808)))
    assert log_odds_after([NEAR] * 20 + [FAR] * 3, OctreeConfig()) > 2.0


def test_a_hit_ends_the_run():
    config = OctreeConfig(dynamic="seen-through", seen_through_scans=3)
    flickering = [NEAR] * 5 + [FAR, FAR, NEAR] * 4

    assert log_odds_after(flickering, config) == log_odds_after(flickering, OctreeConfig())


def test_other_voxels_are_left_to_octomap():
    scans = [NEAR] * 4 + [FAR] * 3
    plain, policy = OctreeMap(OctreeConfig()), OctreeMap(OctreeConfig(dynamic="seen-through"))
    for points in scans:
        plain.insert_points(points, ORIGIN)
        policy.insert_points(points, ORIGIN)

    a, b = plain.leaves(), policy.leaves()
    np.testing.assert_array_equal(a.keys, b.keys)
    differs = np.flatnonzero(a.log_odds != b.log_odds)
    assert np.allclose(a.centres_world[differs], NEAR, atol=1e-6)
    assert len(differs) == 1
