import numpy as np
import pytest

from mapper.core.errors import MapSizeError, PlanError
from mapper.core.geometry import path_length
from mapper.navigation.config import PlanConfig
from mapper.navigation.distance import distance_field, layer
from mapper.navigation.path_search import shortest_path
from mapper.navigation.planner import plan_2d, plan_3d
from mapper.octree.config import OctreeConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.map import OctreeMap

CELL = 0.05
POINT = PlanConfig(radius_m=0.0)


def dijkstra_lengths(free, start):
    """Return the shortest length from a cell to every cell by scipy, steps as documented."""
    sparse = pytest.importorskip("scipy.sparse", reason="the oracle for path lengths")
    from scipy.sparse.csgraph import dijkstra

    index = np.arange(free.size).reshape(free.shape)
    rows, columns, lengths = [], [], []
    for step in np.ndindex(3, 3, 3):
        step = np.array(step) - 1
        if not step.any():
            continue
        here = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip(step, free.shape, strict=True))
        if any(s.start >= s.stop for s in here):
            continue
        allowed = np.ones(index[here].shape, np.bool_)
        for corner in np.ndindex(2, 2, 2):  # every cell that the step touches
            moved = step * corner
            allowed &= free[tuple(slice(s.start + d, s.stop + d) for s, d in zip(here, moved, strict=True))]
        there = tuple(slice(s.start + d, s.stop + d) for s, d in zip(here, step, strict=True))
        rows.append(index[here][allowed])
        columns.append(index[there][allowed])
        lengths.append(np.full(allowed.sum(), np.linalg.norm(step)))
    graph = sparse.csr_array(
        (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), (free.size, free.size)
    )
    return dijkstra(graph, indices=index[start]).reshape(free.shape)


@pytest.mark.parametrize("shape", [(1, 40, 50), (6, 15, 12)], ids=["plane", "space"])
@pytest.mark.parametrize("seed", range(4))
def test_the_search_is_as_short_as_dijkstra_s_in_every_direction(shape, seed):
    rng = np.random.default_rng(seed)
    free = rng.random(shape) > 0.2
    cells = [tuple(cell) for cell in rng.choice(np.argwhere(free), 12)]
    for start in cells[:3]:
        expected = dijkstra_lengths(free, start)
        for goal in cells:
            found = shortest_path(free, start, goal)
            assert found.reached == np.isfinite(expected[goal])
            assert tuple(found.cells[0]) == start
            assert free[tuple(found.cells.T)].all()
            if found.reached:
                assert path_length(found.cells) == pytest.approx(expected[goal], abs=1e-9)


def room_with_a_wall(*, gap_cells=8):
    """Make 4 m × 3 m of free floor with a wall across it, open at the top."""
    cells = np.full((60, 80), FREE, np.int8)
    cells[: 60 - gap_cells, 40] = OCCUPIED
    return OccupancyGrid(cells, np.array([-2.0, 1.0]), CELL)


def test_a_path_rounds_the_corner_as_a_taut_string_would():
    start, goal = np.array([-1.0, 2.0]), np.array([1.05, 2.0])
    plan = plan_2d(room_with_a_wall(), start, goal, config=PlanConfig(radius_m=0.1, unknown="free"))

    np.testing.assert_array_equal(plan.waypoints_world[[0, -1]], [start, goal])
    corner_left, corner_right, radius = np.array([0.0, 3.6]), np.array([0.05, 3.6]), 0.1
    taut_m = 0.05  # along the wall's end, then two tangents with two arcs
    for end, corner in ((start, corner_left), (goal, corner_right)):
        away = np.linalg.norm(end - corner)
        tangent = np.sqrt(away**2 - radius**2)
        below = np.arctan2(corner[1] - end[1], abs(corner[0] - end[0]))
        taut_m += tangent + radius * (below + np.arcsin(radius / away))
    assert 0.995 * taut_m < plan.length_m < 1.02 * taut_m
    assert plan.min_clearance_m >= 0.1 - 1e-5
    assert plan.length_m == pytest.approx(path_length(plan.waypoints_world))


@pytest.mark.parametrize("seed", range(5))
def test_every_point_of_a_path_keeps_the_radius(seed):
    rng = np.random.default_rng(seed)
    cells = np.full((80, 80), FREE, np.int8)
    for y, x in rng.integers(11, 62, (25, 2)):
        cells[y : y + rng.integers(1, 6), x : x + rng.integers(1, 6)] = OCCUPIED
    grid = OccupancyGrid(cells, np.array([0.3, -7.0]), CELL)
    ends = grid.origin_world_m + np.array([[0.25, 0.3], [3.71, 3.62]])

    plan = plan_2d(grid, *ends, config=PlanConfig(radius_m=0.12))

    shares = np.linspace(0.0, 1.0, 400)[:, np.newaxis]
    path = np.vstack(
        [a + shares * (b - a) for a, b in zip(plan.waypoints_world, plan.waypoints_world[1:], strict=False)]
    )
    corners = grid.origin_world_m + np.argwhere(cells == OCCUPIED)[:, ::-1] * CELL
    outside = np.maximum(np.maximum(corners[:, np.newaxis] - path, path - corners[:, np.newaxis] - CELL), 0.0)
    true_clearance_m = np.linalg.norm(outside, axis=2).min()
    assert true_clearance_m > 0.12 - 0.1 * CELL  # between centres distances are interpolated
    assert plan.min_clearance_m >= 0.12 - 1e-5
    straight_m = np.linalg.norm(ends[1] - ends[0])
    free = distance_field(layer(grid), unknown_blocks=True).distances_m[0, 1:-1, 1:-1] >= 0.12
    start, goal = ((0, *np.floor((end - grid.origin_world_m) / CELL).astype(int)[::-1]) for end in ends)
    over_centres_m = CELL * path_length(shortest_path(free[np.newaxis], start, goal).cells)
    assert straight_m <= plan.length_m <= over_centres_m + 2 * CELL  # both ends lie off their cells' centres


def test_a_narrow_gap_lets_a_small_robot_through_only():
    cells = np.full((40, 60), FREE, np.int8)
    cells[:, 30] = OCCUPIED
    cells[18:22, 30] = FREE  # 0.2 m wide
    grid = OccupancyGrid(cells, np.zeros(2), CELL)
    start, goal = np.array([0.7, 0.7]), np.array([2.3, 1.4])
    assert plan_2d(grid, start, goal, config=PlanConfig(radius_m=0.07)).min_clearance_m < 0.1
    with pytest.raises(
        PlanError, match=r"no path from \(0\.700, 0\.700\) to \(2\.300, 1\.400\) for a radius of 0\.11 m"
    ):
        plan_2d(grid, start, goal, config=PlanConfig(radius_m=0.11))


@pytest.mark.parametrize(
    ("start", "complaint"),
    [
        ((0.025, 2.0), r"the start \(0\.025, 2\.000\) lies in an obstacle; the nearest free point is \("),
        ((-0.05, 2.0), r"is 0\.050 m from what is blocked, too close for a radius of 0\.2 m; the nearest"),
        ((-9.0, 2.0), r"lies outside the map, which spans \(-2\.000, 1\.000\) to \(2\.000, 4\.000\) m"),
        ((-1.0, 3.9), r"lies in unknown space; the nearest free point is .* or let unknown"),
        ((np.nan, 0.0), r"the start \[nan, 0\.0, 0\.0\] is no point"),
    ],
)
def test_a_bad_start_names_the_remedy(start, complaint):
    grid = room_with_a_wall()
    cells = grid.cells.copy()
    cells[55:, :30] = UNKNOWN
    grid = OccupancyGrid(cells, grid.origin_world_m, CELL)
    with pytest.raises(PlanError, match=complaint) as caught:
        plan_2d(grid, np.array(start), np.array([1.0, 2.0]), config=PlanConfig())
    assert "\n" not in str(caught.value)


def test_unknown_space_is_crossed_only_if_it_counts_as_free():
    cells = np.full((20, 40), FREE, np.int8)
    cells[:, 18:22] = UNKNOWN
    grid = OccupancyGrid(cells, np.zeros(2), CELL)
    ends = np.array([0.5, 0.5]), np.array([1.5, 0.5])
    with pytest.raises(PlanError, match="no path"):
        plan_2d(grid, *ends, config=PlanConfig(radius_m=0.1))
    assert plan_2d(grid, *ends, config=PlanConfig(radius_m=0.1, unknown="free")).length_m == pytest.approx(
        1.0
    )


def test_a_point_robot_may_stay_where_it_is():
    plan = plan_2d(room_with_a_wall(), np.array([-1.0, 2.0]), np.array([-1.0, 2.0]), config=POINT)
    assert plan.length_m == 0.0
    assert len(plan.waypoints_world) == 2


@pytest.fixture(scope="module")
def chamber():
    """Return a box room of 2 m × 1 m × 1 m, seen from inside, with a wall across it up to 0.6 m."""
    octree = OctreeMap(OctreeConfig(resolution_m=0.05, max_range_m=20.0))
    side = np.arange(-0.025, 2.1, 0.025)
    x, y, z = (g.ravel() for g in np.meshgrid(side, side[side < 1.05], side[side < 1.05], indexing="ij"))
    shell = (x < 0) | (x > 2.0) | (y < 0) | (y > 1.0) | (z < 0) | (z > 1.0)
    points = np.column_stack([x, y, z])[shell].astype(np.float32)
    for origin in ([0.5, 0.5, 0.8], [1.5, 0.5, 0.8], [1.0, 0.5, 0.8], [0.5, 0.5, 0.3], [1.5, 0.5, 0.3]):
        octree.insert_points(points, np.array(origin))
    wall = np.column_stack(
        [np.full(4000, 1.025), *np.random.default_rng(0).uniform([0, 0], [1, 0.6], (4000, 2)).T]
    )
    for _ in range(8):
        octree.insert_points(wall.astype(np.float32), np.array([0.5, 0.5, 0.8]))
    return octree


def test_in_space_a_ball_flies_over_the_wall(chamber):
    start, goal = np.array([0.4, 0.5, 0.3]), np.array([1.6, 0.5, 0.3])
    plan = plan_3d(chamber, start, goal, config=PlanConfig(radius_m=0.1))

    np.testing.assert_array_equal(plan.waypoints_world[[0, -1]], [start, goal])
    assert plan.waypoints_world[:, 2].max() > 0.68
    assert plan.min_clearance_m >= 0.1 - 1e-5
    over = 2 * np.hypot(0.6, 0.4)  # the string over the wall's edge, without the ball's own size
    assert over < plan.length_m < 1.1 * over


def test_in_space_a_ball_keeps_out_of_regions(chamber):
    start, goal = np.array([0.4, 0.5, 0.3]), np.array([1.6, 0.5, 0.3])

    def keep_out(points):  # over the wall, but for a passage at high y
        return (np.abs(points[:, 0] - 1.0) < 0.1) & (points[:, 1] < 0.6)

    plan = plan_3d(chamber, start, goal, config=PlanConfig(radius_m=0.1), keep_out=keep_out)
    assert plan.waypoints_world[:, 1].max() >= 0.69
    assert plan.min_clearance_m >= 0.1 - 1e-5
    with pytest.raises(PlanError, match=r"the start \(0\.400, 0\.500, 0\.300\) lies in an obstacle"):
        plan_3d(chamber, start, goal, config=PlanConfig(radius_m=0.1), keep_out=lambda p: p[:, 0] < 0.5)
    with pytest.raises(PlanError, match="no path"):
        plan_3d(
            chamber, start, goal, config=PlanConfig(radius_m=0.1), keep_out=lambda p: abs(p[:, 0] - 1.0) < 0.1
        )


def test_a_map_too_large_is_refused(chamber, monkeypatch):
    monkeypatch.setattr("mapper.navigation.distance.LIMIT_BYTES", 1000)
    with pytest.raises(MapSizeError, match=r"needs .* GiB of working space"):
        plan_3d(chamber, np.zeros(3), np.ones(3), config=POINT)
