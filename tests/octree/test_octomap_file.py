import struct

import numpy as np
import pyoctomap
import pytest

from mapper.core.errors import MapFileError, MapSizeError
from mapper.octree import sparse_grid
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import KEY_BITS
from mapper.octree.map import OctreeMap, read_octree
from mapper.octree.octomap_file import TreeLeaves, write_bt, write_ot
from mapper.octree.sparse_grid import log_odds
from tests.support.octomap_oracle import fuse
from tests.support.octree_maps import octree_of
from tests.support.paths import DATA

BOTH_KINDS = pytest.mark.parametrize("write", [write_bt, write_ot], ids=["bt", "ot"])
FREE, OCCUPIED = log_odds(0.1192), log_odds(0.971)


def saturated_scans(seed, *, repeats=8):
    """Scans of the same ends until much of the free space is clamped, so that OctoMap prunes."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.6, 0.6, (600, 3)).astype(np.float32)
    return [(points, rng.uniform(0.0, 0.04, 3)) for _ in range(repeats)]


@pytest.fixture(scope="module")
def octree():
    return octree_of(saturated_scans(0))


@pytest.fixture(scope="module")
def their_tree():
    return fuse(saturated_scans(0), resolution_m=0.05, max_range_m=4.0, discretize=True)


def assert_equal_leaves(octree, other):
    np.testing.assert_array_equal(octree.leaves().keys, other.leaves().keys)
    np.testing.assert_array_equal(octree.leaves().log_odds, other.leaves().log_odds)
    assert len(octree) == len(other)


def test_files_equal_the_cpp_library_s_byte_for_byte(octree, their_tree, tmp_path):
    assert their_tree.getNumLeafNodes() < 0.9 * len(octree)  # pruning has something to do

    write_ot(tmp_path / "map.ot", octree)
    write_bt(tmp_path / "map.bt", octree)

    assert (tmp_path / "map.ot").read_bytes() == their_tree.write()
    their_tree.read(str(tmp_path / "map.ot"))  # writeBinary destroys log-odds: work on a copy
    assert (tmp_path / "map.bt").read_bytes() == their_tree.writeBinary()


@pytest.mark.parametrize("blocks_at_once", [1, 3, 8])
def test_files_written_some_blocks_at_a_time_are_the_same(octree, blocks_at_once, tmp_path, monkeypatch):
    write_ot(tmp_path / "at once.ot", octree)
    monkeypatch.setattr("mapper.octree.octomap_tree.BLOCKS_AT_ONCE", blocks_at_once)

    write_ot(tmp_path / "map.ot", octree)

    assert len(octree.blocks) > 8
    assert (tmp_path / "map.ot").read_bytes() == (tmp_path / "at once.ot").read_bytes()


@pytest.mark.parametrize("blocks_at_once", [1, 3, 8])
@pytest.mark.parametrize("depths", [[11], [12, 13, 16], [13, 11, 16]])
def test_nodes_pruned_above_blocks_are_written_some_blocks_at_a_time(
    depths, blocks_at_once, tmp_path, monkeypatch
):
    octree = OctreeMap(0.05)
    codes = np.array([number << 3 * (KEY_BITS - 11) for number in range(len(depths))])
    octree.restore(TreeLeaves(codes, np.array(depths, np.uint8), np.full(len(depths), OCCUPIED)))
    write_ot(tmp_path / "at once.ot", octree)
    monkeypatch.setattr("mapper.octree.octomap_tree.BLOCKS_AT_ONCE", blocks_at_once)

    write_ot(tmp_path / "map.ot", octree)

    assert (tmp_path / "map.ot").read_bytes() == (tmp_path / "at once.ot").read_bytes()
    assert_equal_leaves(read_octree(tmp_path / "map.ot"), octree)


def test_bt_keeps_free_occupied_and_unknown(octree, tmp_path):
    write_bt(tmp_path / "map.bt", octree)

    read, leaves = read_octree(tmp_path / "map.bt").leaves(), octree.leaves()

    np.testing.assert_array_equal(read.keys, leaves.keys)
    np.testing.assert_array_equal(read.log_odds, np.where(leaves.log_odds >= 0, OCCUPIED, FREE))


@BOTH_KINDS
def test_an_empty_map_is_a_file_without_payload(write, tmp_path):
    write(tmp_path / "map", OctreeMap(OctreeConfig(resolution_m=0.125)))

    assert (tmp_path / "map").read_bytes().endswith(b"id OcTree\nsize 0\nres 0.125\ndata\n")
    assert len(read_octree(tmp_path / "map")) == 0
    assert read_octree(tmp_path / "map").resolution_m == 0.125


@pytest.mark.skipif(not DATA.exists(), reason="needs ../shared/data/octomap")
@pytest.mark.parametrize("name", ["geb079.bt", "freiburg1_360.bt", "velma.ot"])
def test_published_maps_survive_a_round_trip(name, tmp_path):
    path = DATA / "octomap" / name
    octree = read_octree(path)
    write = write_bt if path.suffix == ".bt" else write_ot

    write(tmp_path / "again", octree)

    if path.suffix == ".bt":  # velma.ot was written unpruned
        payload = (tmp_path / "again").read_bytes().partition(b"data\n")[2]
        assert payload == path.read_bytes().partition(b"data\n")[2]
    else:
        assert_equal_leaves(read_octree(tmp_path / "again"), octree)


@pytest.mark.skipif(not DATA.exists(), reason="needs ../shared/data/octomap")
def test_a_published_map_reads_as_the_cpp_library_reads_it():
    path = DATA / "octomap" / "velma.ot"
    octree, tree = read_octree(path), pyoctomap.OcTree(0.1).read(str(path))

    theirs = [
        (leaf.getCoordinate(), leaf.current_node.getLogOdds(), leaf.getDepth()) for leaf in tree.begin_leafs()
    ]

    assert len(octree) == sum(8 ** (16 - depth) for _, _, depth in theirs)
    inside = np.array([centre for centre, _, _ in theirs]) + 0.01  # off the corner at a pruned leaf's centre
    assert octree.log_odds_at(inside).tolist() == [value for _, value, _ in theirs]


def test_a_color_octree_gives_its_log_odds(tmp_path):
    tree = pyoctomap.ColorOcTree(0.1)
    for i in range(20):
        tree.updateNode(np.array([0.1 * i, -0.3 * i, 0.05]), i % 2 == 0)
    tree.write(str(tmp_path / "color.ot"))

    octree = read_octree(tmp_path / "color.ot")

    centres = np.array([[0.1 * i, -0.3 * i, 0.05] for i in range(20)])
    assert len(octree) == 20
    assert octree.log_odds_at(centres + 1e-6).tolist() == [log_odds(0.7), log_odds(0.4)] * 10


HEADER = b"# Octomap OcTree file\n# comment\nid OcTree\nsize 1\nres 0.1\ndata\n"
DEEP = b"".join(struct.pack("<fB", 1.0, 1) for _ in range(16)) + struct.pack("<fB", 1.0, 0)


@pytest.mark.parametrize(
    "header",
    [
        b"# Octomap OcTree file\nres 0.1\nsize 17\nid OcTree\ndata\n",
        b"# Octomap OcTree file version 2\n\n#x\nid 1\n# y z\nsize 17\nres 1e-1\nauthor me\ndata\n",
        b"# Octomap OcTree file\r\nid OcTree\r\nsize 17\r\nres 0.1\r\ndata\n",
    ],
    ids=["order", "comments", "crlf"],
)
def test_headers_may_differ(header, tmp_path):
    (tmp_path / "map.ot").write_bytes(header + DEEP)

    leaves = read_octree(tmp_path / "map.ot").leaves()

    assert leaves.keys.tolist() == [[0, 0, 0]]
    assert leaves.resolution_m == 0.1


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"ply\nformat ascii 1.0\n",
        HEADER[:40],
        *(HEADER.replace(line, b"") for line in (b"size 1\n", b"res 0.1\n", b"id OcTree\n")),
        HEADER.replace(b"id OcTree", b"id CountingOcTree"),
        *(HEADER.replace(b"size 1", size) for size in (b"size -1", b"size many")),
        *(HEADER.replace(b"res 0.1", resolution) for resolution in (b"res 0", b"res nan")),
        HEADER.replace(b"size 1", b"size 0") + b"x",
        HEADER.replace(b"size 1", b"size 16") + DEEP,
        HEADER.replace(b"size 1", b"size 999999999999") + DEEP,
        HEADER.replace(b"size 1", b"size 18") + DEEP[:5] + DEEP,
        HEADER.replace(b"size 1", b"size 16") + DEEP[:80],
        HEADER.replace(b"size 1", b"size 18") + DEEP + DEEP[-5:],
        HEADER.replace(b"size 1", b"size 17") + DEEP[:80] + struct.pack("<fB", np.nan, 0),
    ],
)
def test_files_that_are_no_maps_are_refused_in_one_line(data, tmp_path):
    (tmp_path / "map.ot").write_bytes(data)

    with pytest.raises(MapFileError) as caught:
        read_octree(tmp_path / "map.ot")
    assert "\n" not in str(caught.value)
    assert str(tmp_path / "map.ot") in str(caught.value)


@pytest.mark.parametrize("change", ["smaller", "larger", "huge"])
def test_a_bt_of_another_size_is_refused(octree, change, tmp_path):
    write_bt(tmp_path / "map.bt", octree)
    data = (tmp_path / "map.bt").read_bytes()
    size = int(data.split(b"size ")[1].split(b"\n")[0])
    wrong = {"smaller": size - 1, "larger": size + 1, "huge": 10**12}[change]
    (tmp_path / "map.bt").write_bytes(data.replace(b"size %d" % size, b"size %d" % wrong))

    with pytest.raises(MapFileError, match=f"{wrong} nodes"):
        read_octree(tmp_path / "map.bt")


@BOTH_KINDS
@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_truncated_files_are_refused(write, octree, share, tmp_path):
    write(tmp_path / "map", octree)
    data = (tmp_path / "map").read_bytes()
    (tmp_path / "map").write_bytes(data[: int(share * len(data)) // 2 * 2])

    with pytest.raises(MapFileError, match=r"truncated|promises|cannot hold"):
        read_octree(tmp_path / "map")


@BOTH_KINDS
def test_no_damage_goes_unnoticed_as_anything_but_a_map_or_an_error(write, octree, tmp_path, monkeypatch):
    # A flipped bit can turn a small leaf into a huge one: the machine pretends to have 64 MiB.
    monkeypatch.setattr(
        sparse_grid.os, "sysconf", lambda name: {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2**14}[name]
    )
    write(tmp_path / "map", octree)
    data = (tmp_path / "map").read_bytes()
    rng = np.random.default_rng(0)
    outcomes = {"read": 0, "refused": 0}
    for _ in range(150):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            damaged[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "damaged").write_bytes(damaged)
        try:
            assert len(read_octree(tmp_path / "damaged").leaves().keys) >= 0
            outcomes["read"] += 1
        except (MapFileError, MapSizeError):
            outcomes["refused"] += 1
    assert outcomes["refused"] > 20  # log-odds of an .ot may change unnoticed, its structure may not


def test_a_leaf_too_large_for_memory_is_refused(tmp_path):
    data = HEADER.replace(b"size 1", b"size 2") + struct.pack("<fB", 1.0, 1) + struct.pack("<fB", 1.0, 0)
    (tmp_path / "map.ot").write_bytes(data)

    with pytest.raises(MapSizeError, match="pruned leaves expanded needs 131072"):
        read_octree(tmp_path / "map.ot")
