"""Maps resample into another frame: the value at each voxel's centre, and nothing lost."""

import numpy as np
import pytest

from mapper.core.errors import MapSizeError
from mapper.core.geometry import apply, exp, inverse
from mapper.octree.resampling import blocks_reached, resample
from tests.support.octree_maps import COLORED, CONFIG, as_dict, mapped


def moved(octree, T_map_world, *, config=CONFIG):
    codes = blocks_reached(octree, T_map_world)
    return resample(octree, inverse(T_map_world), codes, config)


def some_motion(seed):
    rng = np.random.default_rng(seed)
    return exp(rng.normal(0.0, 1.0, 3), rng.normal(0.0, 5.0, 3))


@pytest.mark.parametrize("seed", range(4))
def test_every_voxel_holds_what_lies_at_its_centre(seed):
    octree, T_map_world = mapped(seed), some_motion(seed)

    found = moved(octree, T_map_world)

    leaves = found.leaves()
    np.testing.assert_array_equal(
        octree.log_odds_at(apply(inverse(T_map_world), leaves.centres_world)), leaves.log_odds
    )
    # and nothing is missing: voxels all around the moved map that are not in it are unknown there
    edge = found.resolution_m
    low, high = (np.floor(f(leaves.centres_world, axis=0) / edge).astype(int) for f in (np.min, np.max))
    rng = np.random.default_rng(seed)
    probes = (rng.integers(low - 20, high + 20, (20_000, 3)) + 0.5) * edge
    np.testing.assert_array_equal(
        found.log_odds_at(probes), octree.log_odds_at(apply(inverse(T_map_world), probes))
    )


def test_a_shift_by_whole_voxels_loses_nothing():
    octree, T_map_world = mapped(5), np.eye(4)
    T_map_world[:3, 3] = np.array([3, -20, 7]) * CONFIG.resolution_m

    found = as_dict(moved(octree, T_map_world))

    shifted = {(x + 3, y - 20, z + 7): value for (x, y, z), value in as_dict(octree).items()}
    assert found == shifted


def test_attributes_come_along():
    octree, T_map_world = mapped(6, config=COLORED), some_motion(6)

    found = moved(octree, T_map_world, config=COLORED)

    centres = found.leaves().centres_world
    here, there = found.attributes.at(centres), octree.attributes.at(apply(inverse(T_map_world), centres))
    for name in ("colors", "colored", "hits", "last_seen_ns"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
    assert here.colored.any()


def test_a_map_beyond_the_key_range_is_refused():
    T_map_world = np.eye(4)
    T_map_world[0, 3] = 3276.0

    with pytest.raises(MapSizeError, match=r"reaches 327\d m from the map's origin.* ends at 3276\.8 m"):
        blocks_reached(mapped(7), T_map_world)
