"""The compiled kernels of insertion, against slow twins in plain NumPy that a reader believes at sight."""

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.octree import ray_casting_kernels as kernels
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import KEY_ZERO, keys_of
from mapper.octree.map import OctreeMap
from mapper.octree.ray_casting import Caster
from mapper.octree.scan_updates import pack
from mapper.octree.sparse_grid import sensor_model
from tests.support.octree_maps import as_dict


def key_reference(points, resolution_m):
    return np.floor((1.0 / resolution_m) * np.asarray(points, np.float64)).astype(int) + KEY_ZERO


def cast_ray_reference(origin, stop, resolution_m):
    """Keys that a ray frees, one by one (Amanatides & Woo 1987), in OctoMap's mixture of precisions."""
    key, end = key_reference(origin, resolution_m), key_reference(stop, resolution_m)
    ray = stop - origin
    norm = np.float32(np.sqrt(np.float64(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])))
    direction = (ray / norm).astype(np.float64)
    step = np.sign(direction).astype(int)
    border = (key - KEY_ZERO + 0.5) * resolution_m + step * np.float64(np.float32(resolution_m * 0.5))
    with np.errstate(divide="ignore", invalid="ignore"):
        t_max = np.where(step == 0, np.inf, (border - origin.astype(np.float64)) / direction)
        t_delta = np.where(step == 0, np.inf, resolution_m / np.abs(direction))
    freed = []
    while (key != end).any():
        freed.append(tuple(key.tolist()))
        axis = 0 if t_max[0] < t_max[1] else 1
        axis = axis if t_max[axis] < t_max[2] else 2
        key[axis] += step[axis]
        t_max[axis] += t_delta[axis]
        if t_max.min() > norm:
            break
    return freed


def planes(update):
    """Return the keys of the free and of the occupied voxels of a scan update."""
    found = []
    for plane in (update.free, update.occupied):
        blocks, voxels = np.nonzero(np.unpackbits(plane, axis=1, bitorder="little"))
        found.append(set(map(tuple, keys_of(update.codes[blocks] << 9 | voxels).tolist())))
    return found


@pytest.mark.parametrize("resolution_m", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_rays_visit_the_voxels_of_the_reference(seed, resolution_m):
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-30.0, 30.0, 3).round(seed)  # rounded: rays through borders, edges and corners
    stops = (origin + rng.uniform(-4.0, 4.0, (40, 3)).round(seed)).astype(np.float32)
    stops = stops[(stops != origin).any(axis=1)]
    config = OctreeConfig(resolution_m=resolution_m, discretize=False)

    update = pack(Caster(config).cast(Scan(0, stops, origin), np.eye(4)))

    occupied = set(map(tuple, key_reference(stops, resolution_m).tolist()))
    start = origin.astype(np.float32)
    free = {key for stop in stops for key in cast_ray_reference(start, stop, resolution_m)}
    assert planes(update) == [free - occupied, occupied]


@pytest.mark.parametrize("seed", range(3))
def test_end_voxels_are_those_of_the_points(seed):
    rng = np.random.default_rng(seed)
    T_world_body = exp(rng.normal(0.0, 1.0, 3), rng.normal(0.0, 5.0, 3))
    points = np.repeat(rng.normal(0.0, 3.0, (400, 3)), 3, axis=0).astype(np.float32)

    centres, outside = kernels.end_voxels(points, T_world_body, 0.1)

    world = (points.astype(np.float64) @ T_world_body[:3, :3].T + T_world_body[:3, 3]).astype(np.float32)
    keys = np.unique(key_reference(world, 0.1), axis=0)
    assert outside == 0
    np.testing.assert_array_equal(np.unique(key_reference(centres, 0.1), axis=0), keys)


def test_log_odds_are_updated_as_in_the_reference():
    config = OctreeConfig(resolution_m=0.2, clamp_min_probability=0.2, clamp_max_probability=0.8)
    sensor, octree, caster = sensor_model(config), OctreeMap(config), Caster(config)
    rng, expected = np.random.default_rng(0), {}
    for _ in range(6):
        update = pack(caster.cast(Scan(0, rng.normal(0.0, 1.0, (60, 3)).astype(np.float32)), np.eye(4)))
        octree.merge(update)
        free, occupied = planes(update)
        for keys, increment in ((free, sensor.miss), (occupied, sensor.hit)):
            for key in keys:
                value = np.float32(expected.get(key, 0.0) + increment)
                expected[key] = min(max(value, sensor.lowest), sensor.highest)
    assert as_dict(octree) == expected
