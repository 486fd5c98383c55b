import numpy as np
import pytest

from mapper.core.geometry import angle_between, apply, rotation_exp, transform
from mapper.registration.hough import description
from mapper.registration.hough.config import (
    CellsConfig,
    ConstellationConfig,
    GroundConfig,
    LevellingConfig,
    ObjectsConfig,
)
from mapper.registration.hough.description import centres_of
from mapper.registration.hough.ground import find_ground, find_obstacles, level, surroundings
from mapper.registration.hough.ground_kernels import column_heights

HEIGHT_M = 1.7


def field(rng, *, count=20_000, reach_m=30.0, slope=0.0):
    """Return the ground around a sensor, which stands above it."""
    x, y = rng.uniform(-reach_m, reach_m, (2, count))
    return np.column_stack([x, y, slope * x - HEIGHT_M + rng.normal(0.0, 0.02, count)])


def box(rng, x, y, *, size=0.8, height=2.0, count=400):
    """Return points on the sides of a box that stands on the ground."""
    sides = rng.uniform(-0.5, 0.5, (count, 2))
    face = rng.integers(0, 2, count)
    sides[np.arange(count), face] = np.sign(sides[np.arange(count), face]) * 0.5
    return np.column_stack([sides * size + [x, y], rng.uniform(-HEIGHT_M, height - HEIGHT_M, count)])


def centres_in(points, centres):
    around = surroundings(as_scan(points), ConstellationConfig(centres=centres))
    return centres_of(around.obstacles, centres)


def as_scan(points):
    return points.astype(np.float32)


@pytest.fixture
def rng():
    return np.random.default_rng(1)


@pytest.mark.parametrize("tilt_deg", [8.0, 20.0, 35.0])
@pytest.mark.parametrize("about_rad", [0.0, 1.0, 4.0])
def test_levels_a_tilted_scan(rng, tilt_deg, about_rad):
    walls = [box(rng, x, y, size=6.0, height=6.0, count=3000) for x, y in ((12, 3), (-9, 8), (2, -14))]
    axis = np.array([np.cos(about_rad), np.sin(about_rad), 0.0])
    T_body_world = transform(rotation_exp(np.radians(tilt_deg) * axis), np.zeros(3))

    found = level(as_scan(apply(T_body_world, np.concatenate([field(rng), *walls]))), LevellingConfig())

    up = found.T_level_body[:3, :3] @ T_body_world[:3, 2]
    assert np.degrees(np.arccos(min(up[2], 1.0))) < 0.5
    assert np.degrees(found.tilt_rad) == pytest.approx(tilt_deg, abs=0.5)
    assert found.T_level_body[2, 3] == pytest.approx(HEIGHT_M, abs=0.05)


@pytest.mark.parametrize(("max_tilt_rad", "is_levelled"), [(0.7, False), (1.05, True)])
def test_a_sensor_tilted_further_than_usual_needs_another_limit(rng, max_tilt_rad, is_levelled):
    T_body_world = transform(rotation_exp(np.array([0.9, 0.0, 0.0])), np.zeros(3))

    found = level(as_scan(apply(T_body_world, field(rng))), LevellingConfig(max_tilt_rad=max_tilt_rad))

    assert (abs(found.tilt_rad - 0.9) < 0.01) == is_levelled


def test_a_small_tilt_is_the_streets_and_stays(rng):
    found = level(as_scan(field(rng, slope=0.05)), LevellingConfig())

    assert np.degrees(found.tilt_rad) == pytest.approx(np.degrees(np.arctan(0.05)), abs=0.2)
    assert angle_between(found.T_level_body[:3, :3], np.eye(3)) == 0.0
    assert found.T_level_body[2, 3] == pytest.approx(HEIGHT_M, abs=0.05)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_scan_without_ground_is_taken_as_it_is(rng, count):
    wall = np.column_stack([np.full(count, 5.0), *rng.uniform(-1.0, 1.0, (2, count))])

    found = level(as_scan(wall), LevellingConfig())

    assert np.array_equal(found.T_level_body, np.eye(4))
    assert found.inlier_ratio == 0.0


def test_a_slope_is_ground_and_a_box_is_not(rng):
    points = np.concatenate([field(rng, count=60_000, slope=0.08), box(rng, 0.0, 7.0, count=4000)])
    T = transform(np.eye(3), np.array([0.0, 0.0, HEIGHT_M]))

    ground = find_ground(as_scan(points), T, GroundConfig())
    obstacles, heights_m = find_obstacles(as_scan(points), T, ground, GroundConfig())

    seen, heights = ground.at(np.array([20.0, -20.0, 0.0, 100.0]), np.array([0.5, 0.5, 7.0, 0.0]))
    assert seen.tolist() == [True, True, False, False]
    assert heights[:2] == pytest.approx([1.6, -1.6], abs=0.08)
    assert np.abs(obstacles[:, :2] - [0.0, 7.0]).max() < 0.6
    assert heights_m.min() >= 0.4
    assert heights_m.max() <= 2.1


def test_what_is_ground_depends_on_how_far_it_rises_and_how_rough_it_is(rng):
    points = field(rng, count=150_000)
    is_raised = (np.abs(points[:, :2] - [7.0, 7.0]) < 2.0).all(axis=1)
    points[is_raised, 2] += 0.8
    is_rough = (np.abs(points[:, :2] + [7.0, 7.0]) < 2.0).all(axis=1)
    points[is_rough, 2] += rng.uniform(-0.4, 0.4, np.count_nonzero(is_rough))
    T = transform(np.eye(3), np.array([0.0, 0.0, HEIGHT_M]))
    raised, rough = np.array([7.2, -7.2]), np.array([7.2, -7.2])

    def is_ground(**limits):
        return find_ground(as_scan(points), T, GroundConfig(**limits)).at(raised, rough)[0].tolist()

    assert is_ground() == [False, False]
    assert is_ground(max_rise_m=1.0) == [True, False]
    assert is_ground(max_thickness_m=1.0) == [False, True]


def test_obstacles_lie_between_two_heights(rng):
    points = np.concatenate([field(rng, count=60_000), box(rng, 0.0, 7.0, count=4000)])
    T, limits = transform(np.eye(3), np.array([0.0, 0.0, HEIGHT_M])), GroundConfig(min_obstacle_m=1.0)
    limits = limits.model_copy(update={"max_obstacle_m": 1.6, "voxel_m": 0.1})
    ground = find_ground(as_scan(points), T, limits)
    _, heights_m = find_obstacles(as_scan(points), T, ground, limits)
    assert 0.9 <= heights_m.min() < 1.1
    assert 1.5 < heights_m.max() <= 1.7


def test_obstacles_weigh_alike_in_sparse_and_dense_clouds(rng):
    scene = [box(rng, 10.0, 0.0, size=4.0, count=40_000), box(rng, -8.0, 3.0, size=4.0, count=40_000)]
    dense = np.concatenate([field(rng, count=200_000), *scene])
    sparse = dense[rng.random(len(dense)) < 0.1]

    counts = [len(surroundings(as_scan(cloud), ConstellationConfig()).obstacles) for cloud in (dense, sparse)]

    assert counts[1] > 0.8 * counts[0]


def test_cells_are_where_things_stand(rng):
    places = np.array([[10.9, 5.1], [-7.1, 12.9], [3.1, -15.1]])
    scan = np.concatenate([field(rng), *[box(rng, x, y) for x, y in places]])

    centres = centres_in(scan, CellsConfig())

    gaps = np.linalg.norm(places[:, None] - centres[None], axis=2).min(axis=1)
    assert gaps.max() < 0.5


def test_objects_are_the_parts_of_a_group(rng):
    places = np.array([[10.0, 5.0], [10.0, 6.6], [-7.0, 12.0]])  # the first two share coarse cells that touch
    scan = np.concatenate([field(rng), *[box(rng, x, y) for x, y in places]])

    found = centres_in(scan, ObjectsConfig())

    assert len(found) == 3
    gaps = np.linalg.norm(places[:, None] - found[None], axis=2).min(axis=1)
    assert gaps.max() < 0.2
    assert len(centres_in(scan, ObjectsConfig(fine_m=2.0))) == 2
    assert len(centres_in(scan[len(scan) - 400 :], ObjectsConfig(coarse_m=0.1, fine_m=0.1))) > 10


def test_a_group_without_a_large_part_is_one_object(monkeypatch):
    corners = np.array([[0.0, 0.0], [0.9, 0.0], [0.0, 0.9], [0.9, 0.9]])
    scattered = np.column_stack([corners + 4.2, np.ones(4)]).astype(np.float32)

    monkeypatch.setattr(description, "_MIN_VOXELS_RATIO", 2.0)
    centres = centres_of(scattered, ObjectsConfig())

    assert centres == pytest.approx(np.array([[4.65, 4.65]]))


@pytest.mark.parametrize("centres", [CellsConfig(), ObjectsConfig()], ids=lambda c: c.kind)
def test_an_empty_field_has_no_constellation(rng, centres):
    assert len(centres_in(field(rng), centres)) == 0
    assert len(centres_in(np.empty((0, 3)), centres)) == 0


def test_columns_are_those_of_the_moved_points():
    rng = np.random.default_rng(3)
    points = rng.uniform(-6.0, 6.0, (3000, 3))
    T = transform(rotation_exp(np.array([0.3, -0.2, 0.8])), np.array([0.4, -0.7, 1.5]))
    count, low, high, mean = column_heights(points, T, 0.5, 16)
    moved = apply(T, points)
    for row, column in ((3, 12), (8, 8), (14, 1)):
        here = (np.floor(moved[:, :2] / 0.5).astype(int) == (column - 8, row - 8)).all(axis=1)
        z = moved[here, 2]
        assert count[row, column] == len(z) > 0
        np.testing.assert_allclose(
            [low[row, column], high[row, column], mean[row, column]], [z.min(), z.max(), z.mean()], rtol=1e-6
        )
    assert count.sum() == (np.abs(moved[:, :2]) < 4.0).all(axis=1).sum()
