import numpy as np
import pytest
from scipy.spatial import cKDTree

from mapper.core.errors import DataError
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from tests.support.octomap_oracle import fuse
from tests.support.octree_maps import octree_of

ALL_DEPTHS = pytest.mark.parametrize("depth", range(17))


def scans(seed, *, spread_m=1.0, count=6):
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-3.0, 3.0, 3)
    return [
        ((centre + rng.normal(0.0, spread_m, (300, 3))).astype(np.float32), centre + rng.normal(0.0, 0.1, 3))
        for _ in range(count)
    ]


@pytest.fixture(scope="module")
def octree():
    return octree_of(scans(0))


@pytest.fixture(scope="module")
def points(octree):
    centres = octree.leaves().centres_world
    rng = np.random.default_rng(1)
    return rng.uniform(centres.min(axis=0) - 1.0, centres.max(axis=0) + 1.0, (500, 3))


def obstacles(octree):
    leaves = octree.leaves()
    return leaves.centres_world[leaves.log_odds >= octree.occupied_log_odds]


@ALL_DEPTHS
def test_coarse_queries_equal_octomap_s(octree, points, depth):
    tree = fuse(scans(0), resolution_m=0.05, max_range_m=4.0, discretize=True)
    tree.updateInnerOccupancy()

    found = octree.log_odds_at(points, depth=depth)

    assert np.isfinite(found).any()
    for point, value in zip(points, found, strict=True):
        node = tree.search(point, depth) if depth else tree.getRoot()  # to OctoMap depth 0 is the deepest
        theirs = np.nan if node is None else np.float32(node.getLogOdds())
        np.testing.assert_equal(value, theirs)


@ALL_DEPTHS
@pytest.mark.parametrize("parent", ["max", "mean"])
def test_coarse_leaves_join_their_children(octree, depth, parent):
    leaves = octree.leaves(depth=depth, parent=parent)
    if depth == 16:
        np.testing.assert_array_equal(leaves.log_odds, octree.leaves().log_odds)
        return
    children = octree.leaves(depth=depth + 1, parent=parent)
    below = {}
    for key, value in zip((children.keys >> 1).tolist(), children.log_odds, strict=True):
        below.setdefault(tuple(key), []).append(float(value))
    join = max if parent == "max" else np.mean

    assert [tuple(key) for key in leaves.keys.tolist()] == list(below)  # both in Morton order
    np.testing.assert_allclose(
        leaves.log_odds, [join(values) for values in below.values()], rtol=1e-6, atol=1e-6
    )


@ALL_DEPTHS
def test_coarse_leaves_agree_with_coarse_queries(octree, depth):
    leaves = octree.leaves(depth=depth, parent="mean")

    found = octree.log_odds_at(leaves.centres_world, depth=depth, parent="mean")

    np.testing.assert_array_equal(found, leaves.log_odds)
    assert leaves.edge_m == pytest.approx(0.05 * 2 ** (16 - depth))


@pytest.mark.parametrize("levels", [0, 1, 3, 6])
@pytest.mark.parametrize("parent", ["max", "mean"])
def test_a_coarser_map_answers_as_the_level_does(octree, points, levels, parent):
    coarse = octree.coarser(levels, parent=parent)
    assert coarse.resolution_m == pytest.approx(0.05 * 2**levels)
    assert len(coarse) == len(octree.leaves(depth=16 - levels).log_odds)
    wanted = octree.log_odds_at(points, depth=16 - levels, parent=parent)
    np.testing.assert_array_equal(coarse.log_odds_at(points), wanted)


def test_a_coarse_query_outside_the_key_range_is_unknown(octree):
    outside = np.array([[1e9, 0.0, 0.0], [-1e9, 0.0, 0.0], [np.nan, 0.0, 0.0], [1638.5, 0.0, 0.0]])

    assert np.isnan(octree.log_odds_at(outside, depth=3)).all()
    assert np.isnan(octree.log_odds_at(outside, depth=0)).all()


def test_an_empty_map_has_no_nodes():
    assert len(OctreeMap(OctreeConfig()).leaves(depth=4).keys) == 0
    assert np.isnan(OctreeMap(OctreeConfig()).log_odds_at(np.zeros((2, 3)), depth=4)).all()


@pytest.mark.parametrize(("depth", "parent"), [(-1, "max"), (17, "max"), (3, "min")])
def test_what_is_no_level_is_refused(octree, depth, parent):
    with pytest.raises(DataError, match=r"^octree: (depth|parent) "):
        octree.log_odds_at(np.zeros((1, 3)), depth=depth, parent=parent)


@pytest.mark.parametrize("max_range_m", [0.0, 0.03, 0.4, 2.0, np.inf])
@pytest.mark.parametrize("seed", range(3))
def test_nearest_obstacles_equal_brute_force(seed, max_range_m):
    octree = OctreeMap(OctreeConfig())
    for scan_points, origin in scans(seed, spread_m=0.4 + seed, count=2):
        octree.insert_points(scan_points, origin)
    centres = obstacles(octree)
    rng = np.random.default_rng(seed)
    points = np.concatenate(
        [
            centres[:20],
            rng.uniform(centres.min(axis=0) - 3.0, centres.max(axis=0) + 3.0, (200, 3)),
            rng.uniform(-1e5, 1e5, (5, 3)),  # far outside the key range
        ]
    )
    distances_m, _ = cKDTree(centres).query(points)
    within = distances_m <= max_range_m

    found = octree.nearest_obstacles(points, max_range_m=max_range_m)

    clear = np.abs(distances_m - max_range_m) > 1e-9  # of the range by more than rounding
    assert (np.isfinite(found.distances_m) == within)[clear].all()
    hit = within & clear
    np.testing.assert_allclose(found.distances_m[hit], distances_m[hit], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(found.centres_world - points, axis=1)[hit], distances_m[hit], rtol=1e-9, atol=1e-9
    )
    assert np.isnan(found.centres_world[~within & clear]).all()
    near = found.centres_world[hit]
    assert (octree.log_odds_at(near) >= octree.occupied_log_odds).all()


def test_the_nearest_of_equals_does_not_depend_on_the_order_of_scans():
    points = np.array([[1.025, 0.025, 0.025], [-0.975, 0.025, 0.025]], np.float32)
    found = []
    for order in ([0, 1], [1, 0]):
        octree = OctreeMap(OctreeConfig())
        for i in order:
            octree.insert_points(points[i : i + 1], np.array([0.025, 0.025, 0.025]))
        query = octree.nearest_obstacles(np.array([[0.025, 0.025, 0.025]]), max_range_m=5.0)
        found.append(query.centres_world.tolist())

    assert found[0] == found[1]
    np.testing.assert_allclose(found[0], [[-0.975, 0.025, 0.025]])


def test_an_empty_map_has_no_obstacles():
    found = OctreeMap(OctreeConfig()).nearest_obstacles(np.zeros((2, 3)), max_range_m=np.inf)

    assert np.isinf(found.distances_m).all()
    assert np.isnan(found.centres_world).all()


@pytest.mark.parametrize(
    ("points", "max_range_m"),
    [
        (np.zeros((2, 2)), 1.0),
        (np.full((1, 3), np.nan), 1.0),
        (np.zeros((1, 3)), -1.0),
        (np.zeros((1, 3)), np.nan),
    ],
    ids=["shape", "nan", "negative range", "nan range"],
)
def test_nearest_obstacles_of_nothing_are_refused(octree, points, max_range_m):
    with pytest.raises(DataError, match=r"^octree: nearest obstacles "):
        octree.nearest_obstacles(points, max_range_m=max_range_m)
