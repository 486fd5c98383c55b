import numpy as np
import pyoctomap
import pytest

from mapper.core.errors import MapSizeError
from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.octree import attributes as layer_module
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap, read_octree
from mapper.octree.octomap_file import write_bt, write_ot
from tests.support.octree_maps import attributes_of_leaves

BOTH_MODES = pytest.mark.parametrize("discretize", [True, False], ids=["discretize", "every-point"])


def coloured_scan(seed, *, points=400, spread_m=0.7):
    rng = np.random.default_rng(seed)
    return Scan(
        stamp_ns=1_000 + seed,
        points_body=rng.normal(0.0, spread_m, (points, 3)).astype(np.float32),
        origin_body=rng.normal(0.0, 0.05, 3),
        colors=rng.integers(0, 256, (points, 3), dtype=np.uint8),
    )


def pose(seed):
    rng = np.random.default_rng(seed)
    return exp(rng.normal(0.0, 0.3, 3), rng.normal(0.0, 0.3, 3))


def mapped(scans=4, **settings):
    octree = OctreeMap(OctreeConfig(attributes=True, resolution_m=0.1, max_range_m=1.5, **settings))
    for seed in range(scans):
        octree.insert(coloured_scan(seed), pose(seed))
    return octree


@BOTH_MODES
def test_every_hit_voxel_has_the_mean_colour_of_its_points(discretize):
    octree = mapped(discretize=discretize)
    sums = {}
    for seed in range(4):
        scan, T = coloured_scan(seed), pose(seed)
        points = (scan.points_body @ T[:3, :3].T + T[:3, 3]).astype(np.float32).astype(np.float64)
        origin = T[:3, :3] @ scan.origin_body + T[:3, 3]
        keys = np.floor(points / 0.1).astype(int)
        ends = (keys + 0.5) * 0.1 if discretize else points
        near = np.linalg.norm(ends - origin, axis=1) <= 1.5
        for key, color in zip(keys[near].tolist(), scan.colors[near].astype(int), strict=True):
            total, count, _ = sums.get(tuple(key), (0, 0, 0))
            sums[tuple(key)] = total + color, count + 1, scan.stamp_ns
    leaves, found = octree.leaves(), attributes_of_leaves(octree)

    assert 0 < len(sums) < len(leaves.keys)
    hit = found.hits > 0
    assert {tuple(k) for k in (leaves.keys[hit].astype(int) - 32768).tolist()} == set(sums)
    for i in np.flatnonzero(hit):
        total, count, stamp_ns = sums[tuple((leaves.keys[i].astype(int) - 32768).tolist())]
        np.testing.assert_array_equal(found.colors[i], np.floor(total / count + 0.5))
        assert (found.hits[i], found.last_seen_ns[i]) == (count, stamp_ns)


def test_queries_agree_with_leaves_and_find_nothing_elsewhere():
    octree = mapped()
    centres, found = octree.leaves().centres_world, attributes_of_leaves(octree)

    at = octree.attributes.at(centres)

    np.testing.assert_array_equal(at.colors, found.colors)
    np.testing.assert_array_equal(at.colored, found.colored)
    np.testing.assert_array_equal(at.hits, found.hits)
    np.testing.assert_array_equal(at.last_seen_ns, found.last_seen_ns)
    nowhere = np.array([[50.0, 0.0, 0.0], [1e9, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    assert octree.attributes.at(nowhere).hits.tolist() == [0, 0, 0]


def test_scans_without_colour_leave_the_mean_alone():
    octree = mapped()
    before = attributes_of_leaves(octree)
    for seed in range(4):
        scan = coloured_scan(seed)
        octree.insert(Scan(5_000, scan.points_body, scan.origin_body), pose(seed))

    after = attributes_of_leaves(octree)
    np.testing.assert_array_equal(after.colors, before.colors)
    np.testing.assert_array_equal(after.hits, 2 * before.hits)
    assert set(after.last_seen_ns[after.hits > 0]) == {5_000}


def test_sums_never_overflow():
    octree = OctreeMap(OctreeConfig(attributes=True))
    points = np.full((1000, 3), 0.51, np.float32)
    octree.insert(Scan(0, points, colors=np.full((1000, 3), 200, np.uint8)), np.eye(4))
    layer = octree.attributes.arrays
    row = np.argmax(layer.color_weights.max(axis=1))
    voxel = np.argmax(layer.color_weights[row])
    layer.color_weights[row, voxel] = 1 << 24
    layer.color_sums[row, voxel] = 200 << 24

    octree.insert(Scan(1, points, colors=np.full((1000, 3), 100, np.uint8)), np.eye(4))

    assert layer.color_weights[row, voxel] == (1 << 23) + 1000
    assert octree.attributes.at(np.full((1, 3), 0.51)).colors.tolist() == [[200, 200, 200]]


def test_a_layer_too_large_for_memory_is_refused_before_anything_changes(monkeypatch):
    octree = mapped(scans=1)
    before = octree.leaves()
    monkeypatch.setattr(layer_module, "check_memory", refuse)
    far = np.random.default_rng(0).uniform(-1.4, 1.4, (5000, 3)).astype(np.float32)

    with pytest.raises(MapSizeError, match=r"attributes of .* blocks"):
        octree.insert(Scan(0, far), exp(np.zeros(3), np.array([20.0, 0.0, 0.0])))

    np.testing.assert_array_equal(octree.leaves().keys, before.keys)


def refuse(_needed_bytes, what):
    raise MapSizeError(what)


def saturated(seed, *, holes):
    """A map in which whole blocks are occupied, so that OctoMap prunes coloured voxels."""
    rng = np.random.default_rng(seed)
    octree = OctreeMap(OctreeConfig(attributes=True, resolution_m=0.1, max_range_m=50.0, discretize=False))
    grid = np.stack(np.meshgrid(*[np.arange(-12, 20)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = ((grid + 0.5) * 0.1).astype(np.float32)[rng.uniform(size=len(grid)) >= holes]
    for stamp_ns in range(6):
        octree.insert(Scan(stamp_ns, points), np.eye(4))
    coloured = points[rng.uniform(size=len(points)) < 0.9]
    colors = rng.integers(0, 256, coloured.shape, dtype=np.uint8)
    octree.insert(Scan(9, coloured, colors=colors), np.eye(4))
    return octree


def their_tree(octree):
    """The same log-odds and colours in the C++ library's hands."""
    tree = pyoctomap.ColorOcTree(octree.resolution_m)
    leaves, found = octree.leaves(), attributes_of_leaves(octree)
    for centre, value, color, colored in zip(
        leaves.centres_world, leaves.log_odds, found.colors, found.colored, strict=True
    ):
        node = tree.updateNode(centre, float(value), lazy_eval=True)
        if colored:
            node.setColor(*color.tolist())
    tree.prune()
    tree.updateInnerOccupancy()
    return tree


@pytest.mark.parametrize("holes", [0.0, 0.002, 0.3])
def test_coloured_files_equal_the_cpp_library_s_byte_for_byte(holes, tmp_path):
    octree = saturated(0, holes=holes)

    write_ot(tmp_path / "map.ot", octree)

    tree = their_tree(octree)
    assert tree.write(str(tmp_path / "theirs.ot"))
    assert (tmp_path / "map.ot").read_bytes() == (tmp_path / "theirs.ot").read_bytes()


def test_colours_come_back_from_a_file(tmp_path):
    octree = mapped()
    write_ot(tmp_path / "map.ot", octree)

    again = read_octree(tmp_path / "map.ot")

    found, before = attributes_of_leaves(again), attributes_of_leaves(octree)
    np.testing.assert_array_equal(again.leaves().log_odds, octree.leaves().log_odds)
    np.testing.assert_array_equal(found.colors, before.colors)
    assert (found.hits == 0).all()  # a ColorOcTree has no place for them
    write_ot(tmp_path / "again.ot", again)
    assert (tmp_path / "again.ot").read_bytes() == (tmp_path / "map.ot").read_bytes()


def test_a_map_without_colours_stays_an_octree(tmp_path):
    octree = OctreeMap(OctreeConfig(attributes=True))
    octree.insert_points(np.full((3, 3), 0.51, np.float32), np.zeros(3))
    write_ot(tmp_path / "map.ot", octree)
    write_bt(tmp_path / "map.bt", octree)

    assert b"id OcTree\n" in (tmp_path / "map.ot").read_bytes()
    assert read_octree(tmp_path / "map.ot").attributes is None
