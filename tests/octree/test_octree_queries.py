import numpy as np
import pytest
from scipy.spatial import cKDTree

from mapper.core.errors import DataError
from mapper.octree.config import OctreeConfig, SliceConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN
from mapper.octree.map import OctreeMap
from mapper.octree.slice import cut_slice
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


@pytest.mark.parametrize("levels", [0, 1, 3, 6])
@pytest.mark.parametrize("parent", ["max", "mean"])
def test_a_coarser_map_answers_as_the_level_does(octree, points, levels, parent):
    coarse = octree.coarser(levels, parent=parent)
    assert coarse.resolution_m == pytest.approx(0.05 * 2**levels)
    assert len(coarse) == len(octree.leaves(depth=16 - levels).log_odds)
    wanted = octree.log_odds_at(points, depth=16 - levels, parent=parent)
    np.testing.assert_array_equal(coarse.log_odds_at(points), wanted)


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
    centres = octree.occupied()
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


@pytest.fixture(scope="module")
def ball():
    """A map of noise around the origin."""
    rng = np.random.default_rng(0)
    return octree_of([(rng.normal(0.0, 1.0, (400, 3)).astype(np.float32), np.zeros(3)) for _ in range(4)])


def test_states_agree_with_the_leaves(ball):
    leaves = ball.leaves()
    expected = np.where(leaves.log_odds >= ball.occupied_log_odds, OCCUPIED, FREE)
    np.testing.assert_array_equal(ball.query(leaves.centres_world), expected)
    assert ball.query([50.0, 0.0, 0.0]) == UNKNOWN
    assert ball.query([[1e9, 0.0, np.nan]]).tolist() == [UNKNOWN]


def test_centres_are_those_of_the_states(ball):
    occupied, free = ball.occupied(), ball.free()
    assert len(occupied) + len(free) == len(ball)
    assert len(occupied) > 100
    assert len(free) > 100
    assert (ball.query(occupied) == OCCUPIED).all()
    assert (ball.query(free) == FREE).all()


def test_probabilities_are_those_of_the_log_odds(ball):
    leaves = ball.leaves()
    np.testing.assert_allclose(
        ball.probability(leaves.centres_world), 1.0 / (1.0 + np.exp(-leaves.log_odds)), rtol=1e-6
    )
    assert np.isnan(ball.probability([50.0, 0.0, 0.0]))


def test_points_have_any_shape_whose_last_axis_is_3(ball):
    grid = ball.occupied()[:24].reshape(2, 3, 4, 3)
    assert ball.query(grid).shape == ball.log_odds_at(grid).shape == (2, 3, 4)
    assert ball.query(np.empty((0, 3))).shape == (0,)
    assert ball.query(grid[0, 0, 0].tolist()).shape == ()


@pytest.mark.parametrize("wrong", [np.zeros((4, 2)), np.zeros((3, 5)), 1.0, [[1, 2], [3]], "abc"])
def test_other_shapes_are_refused_in_one_line(ball, wrong):
    with pytest.raises(DataError, match=r"octree: points") as caught:
        ball.query(wrong)
    assert "\n" not in str(caught.value)


def test_a_slice_is_the_band_between_two_heights(ball):
    grid = ball.slice(-0.2, 0.4)
    expected = cut_slice(ball, SliceConfig(min_height_m=-0.2, max_height_m=0.4))
    np.testing.assert_array_equal(grid.cells, expected.cells)
    centres = ball.occupied()
    centres = centres[(centres[:, 2] > -0.2) & (centres[:, 2] < 0.4)]
    columns = np.floor((centres[:, :2] - grid.origin_world_m) / grid.resolution_m).astype(int)
    assert (grid.cells[columns[:, 1], columns[:, 0]] == OCCUPIED).all()
    assert np.unique(columns, axis=0).shape[0] == (grid.cells == OCCUPIED).sum()
    with pytest.raises(DataError, match="nothing is known"):
        ball.slice(50.0, 51.0)


@pytest.mark.parametrize("height_m", [-0.35, 0.0, 0.15, 0.3, 0.5, 0.6])
def test_a_height_on_a_border_is_in_the_voxels_above_it_as_in_a_query(ball, height_m):
    """0.5 // 0.05 is 9."""
    at, within = ball.slice(height_m), ball.slice(height_m + 0.02)
    np.testing.assert_array_equal(at.cells, within.cells)
    x, y = at.origin_world_m + at.resolution_m * (np.argwhere((at.cells == OCCUPIED).T)[0] + 0.5)
    assert ball.query([x, y, height_m]) == OCCUPIED


@pytest.mark.parametrize("heights_m", [(1.2, 0.1), (0.3, 0.3), (np.nan,), (0.0, np.inf)])
def test_heights_that_are_no_band_are_refused_in_one_line(ball, heights_m):
    with pytest.raises(DataError, match=r"^slice: from .*; want finite heights, the lower one first$"):
        ball.slice(*heights_m)
