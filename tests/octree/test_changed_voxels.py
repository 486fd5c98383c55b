"""Voxels made free or unknown: counts, attributes, and files that OctoMap's C++ library reads."""

import numpy as np
import pyoctomap
import pytest

from mapper.octree.map import read_octree
from mapper.octree.map_file import write_map
from mapper.octree.octomap_file import write_bt, write_ot
from tests.support.octomap_oracle import voxels
from tests.support.octree_maps import COLORED, as_dict, attributes_of_leaves, mapped


def below(octree, x_m):
    """Return all slots, and the mask of the voxels whose centres lie below an x."""
    known = octree.leaves()
    slots = np.arange(len(octree.blocks))
    left = {
        tuple(key) for key, x in zip(known.keys.tolist(), known.centres_world[:, 0], strict=True) if x < x_m
    }
    mask = np.zeros((len(slots), 512), np.bool_)
    for slot, code in enumerate(octree.blocks.codes.tolist()):
        for voxel in range(512):
            whole = code << 9 | voxel
            key = tuple(int(f"{whole:048b}"[2 - axis :: 3], 2) for axis in range(3))
            mask[slot, voxel] = key in left
    return slots, mask


def test_occupied_voxels_become_free_and_others_stay():
    octree, before = mapped(3), as_dict(mapped(3))
    slots, mask = below(octree, 0.0)

    count = octree.set_free(slots, mask)

    after = as_dict(octree)
    changed = [key for key in before if before[key] != after[key]]
    assert len(changed) == count > 50
    assert all(before[key] >= octree.occupied_log_odds for key in changed)
    assert {after[key] for key in changed} == {octree.sensor.lowest}
    assert len(octree) == len(before) == len(after)


@pytest.mark.parametrize("x_m", [-0.75, 0.0, 0.4])
def test_files_of_a_map_whose_blocks_were_emptied_are_those_of_octomap(x_m, tmp_path):
    octree, before = mapped(4), as_dict(mapped(4))
    blocks = len(octree.blocks)
    slots, mask = below(octree, x_m)

    octree.set_unknown(slots, mask)
    octree.drop_unknown()

    left = {key: value for key, value in before.items() if (key[0] - 32768 + 0.5) * 0.1 >= x_m}
    assert as_dict(octree) == left
    assert len(octree) == len(left)
    assert len(octree.blocks) < blocks, "some blocks must have lost all voxels"
    write_ot(tmp_path / "map.ot", octree)
    write_bt(tmp_path / "map.bt", octree)
    write_map(tmp_path / "map.octree", octree)
    assert as_dict(read_octree(tmp_path / "map.octree")) == left
    assert voxels(pyoctomap.OcTree(0.1).read(str(tmp_path / "map.ot")), resolution_m=0.1) == left
    binary = pyoctomap.OcTree(0.1)
    assert binary.readBinary(str(tmp_path / "map.bt"))
    found = voxels(binary, resolution_m=0.1)
    assert {key: value > 0 for key, value in found.items()} == {key: value > 0 for key, value in left.items()}


def test_a_map_goes_on_after_blocks_were_dropped():
    octree, other = mapped(5, config=COLORED), mapped(5, config=COLORED)
    octree.set_unknown(*below(octree, 10.0))
    octree.drop_unknown()
    assert len(octree) == len(octree.blocks) == 0
    assert not octree.attributes.has_colors

    octree.add(other)

    assert as_dict(octree) == as_dict(other)
    np.testing.assert_array_equal(attributes_of_leaves(octree).colors, attributes_of_leaves(other).colors)


def test_attributes_go_with_their_voxels_and_stay_with_the_others(tmp_path):
    octree, before = mapped(6, config=COLORED), mapped(6, config=COLORED)
    octree.set_unknown(*below(octree, 0.0))
    octree.drop_unknown()

    right = before.leaves().centres_world[:, 0] > 0.0
    was, now = attributes_of_leaves(before), attributes_of_leaves(octree)
    for name in ("colors", "hits", "last_seen_ns"):
        np.testing.assert_array_equal(getattr(now, name), getattr(was, name)[right])
    write_map(tmp_path / "map.octree", octree)
    read = read_octree(tmp_path / "map.octree")
    np.testing.assert_array_equal(attributes_of_leaves(read).hits, was.hits[right])
    gone = octree.attributes.at(before.leaves().centres_world[~right])
    assert not gone.hits.any()
    assert not gone.colored.any()
