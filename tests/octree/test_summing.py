"""Independent maps add up voxel by voxel, as OctoMap's own update of single voxels would."""

import numpy as np
import pyoctomap
import pytest

from mapper.octree.attributes import NEVER_SEEN
from mapper.octree.map import read_octree
from mapper.octree.map_file import write_map
from mapper.octree.sparse_grid import Overlap
from tests.support.octomap_oracle import voxels
from tests.support.octree_maps import COLORED, CONFIG, as_dict, mapped, total


def test_five_maps_add_up_as_in_octomap_to_the_last_bit():
    maps = [mapped(seed) for seed in range(5)]

    octree, _ = total(maps)

    tree = pyoctomap.OcTree(CONFIG.resolution_m)
    tree.setClampingThresMin(1e-9)
    tree.setClampingThresMax(1.0 - 1e-9)
    for other in maps:
        leaves = other.leaves()
        for centre, value in zip(leaves.centres_world, leaves.log_odds, strict=True):
            tree.updateNode(centre, float(value))
    lowest, highest = octree.sensor.lowest, octree.sensor.highest
    theirs = voxels(tree, resolution_m=CONFIG.resolution_m)
    assert as_dict(octree) == {key: min(max(value, lowest), highest) for key, value in theirs.items()}
    assert len(octree) == len(theirs)
    assert min(theirs.values()) < lowest  # so there was something to clamp


def test_the_overlap_counts_voxels_known_in_both_maps():
    first, second = mapped(1), mapped(2)
    a, b = as_dict(first), as_dict(second)

    _, overlaps = total([first, second])

    shared = a.keys() & b.keys()
    both = sum(a[key] >= 0 and b[key] >= 0 for key in shared)
    either = sum(a[key] >= 0 or b[key] >= 0 for key in shared)
    assert overlaps == [Overlap(0, 0, 0), Overlap(len(shared), both, either)]
    assert 0 < both < either < len(shared)


def test_attributes_add_up():
    maps = [mapped(seed, config=COLORED) for seed in range(3)]

    octree, _ = total(maps, config=COLORED)

    centres = octree.leaves().centres_world
    found, parts = octree.attributes.at(centres), [other.attributes.at(centres) for other in maps]
    np.testing.assert_array_equal(found.hits, sum(part.hits for part in parts))
    np.testing.assert_array_equal(found.last_seen_ns, np.max([part.last_seen_ns for part in parts], axis=0))
    weights = [part.hits[:, np.newaxis].astype(float) for part in parts]  # every point had a colour
    means = sum(w * part.colors for w, part in zip(weights, parts, strict=True)) / np.maximum(sum(weights), 1)
    seen = found.last_seen_ns != NEVER_SEEN
    assert seen.any()
    assert np.abs(found.colors[seen] - means[seen]).max() <= 1.0


def test_a_colour_of_full_weight_takes_more_without_overflow():
    one, other = (mapped(4, config=COLORED) for _ in range(2))
    for octree in (one, other):
        arrays = octree.attributes.arrays
        held = arrays.color_weights > 0
        arrays.color_weights[held] = 1 << 24
        arrays.color_sums[held] = 200 << 24

    one.add(other)

    arrays = one.attributes.arrays
    held = arrays.color_weights > 0
    assert (arrays.color_weights[held] == 1 << 24).all()
    assert (arrays.color_sums[held] == 200 << 24).all()


@pytest.mark.parametrize("config", [CONFIG, COLORED], ids=["plain", "attributes"])
def test_a_map_added_to_an_empty_one_is_the_same_file(tmp_path, config):
    octree = mapped(6, config=config)
    write_map(tmp_path / "a.octree", octree)

    write_map(tmp_path / "b.octree", total([read_octree(tmp_path / "a.octree")], config=config)[0])

    assert (tmp_path / "b.octree").read_bytes() == (tmp_path / "a.octree").read_bytes()
