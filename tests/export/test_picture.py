import sys

import cv2
import numpy as np
import pytest

from mapper.core.trajectory import Trajectory
from mapper.export.cloud_picture import splat, write_cloud_views
from mapper.export.figures import BACKDROP, DOUBTFUL, ESTIMATE, FACTORS, TRUTH, band_image, new_figure, save
from mapper.export.picture import write_summary
from mapper.mapping.cloud import height_colors
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.run.pose_covariances import UncertainPoses


def room():
    cells = np.full((60, 100), FREE, np.int8)
    cells[[0, -1], :] = OCCUPIED
    cells[:, [0, -1]] = OCCUPIED
    cells[40:50, 20:30] = UNKNOWN
    return OccupancyGrid(cells, np.array([-2.5, -1.5]), 0.05)


NO_LOOPS = np.empty((0, 2, 3))


def loop(*, radius_m=1.0):
    angles = np.linspace(0.0, 2.0 * np.pi, 200)
    poses = np.repeat(np.eye(4)[None], 200, axis=0)
    poses[:, :3, 3] = np.column_stack([radius_m * np.cos(angles), np.sin(angles), np.full(200, 1.2)])
    return Trajectory(np.arange(200, dtype=np.int64), poses)


def pixels_like(picture, rgb):
    return int((np.abs(picture.astype(int) - rgb[::-1]).max(axis=2) <= 12).sum())


@pytest.fixture
def summary(tmp_path):
    """Write a summary, by default of a path without a truth or loops in a room, and read the picture."""

    def written(name="summary.png", **drawing):
        usual = {"grid": room(), "trajectory": loop(), "truth": None, "loops_world": NO_LOOPS}
        write_summary(tmp_path / name, title="a room", **usual | drawing)
        return cv2.imread(str(tmp_path / name))

    return written


def test_summary_shows_estimate_and_truth(summary):
    both, alone = summary(truth=loop(radius_m=1.4), lines=["200 frames"]), summary()
    assert min(both.shape[:2]) > 500
    assert pixels_like(both, ESTIMATE) > 500
    assert pixels_like(alone, ESTIMATE) > 500
    with_alpha = tuple(round(0.65 * c + 0.35 * 255) for c in TRUTH)
    assert pixels_like(both, with_alpha) > 500
    assert pixels_like(alone, with_alpha) == 0


def test_summary_shows_what_loops_tie(summary):
    ends = np.array([[[-0.8, 0.0, 1.2], [0.8, 0.1, 1.2]], [[0.0, -0.8, 1.2], [0.1, 0.8, 1.2]]])
    without, tied = (pixels_like(each, FACTORS["loop"]) for each in (summary(), summary(loops_world=ends)))
    assert tied > without + 100


@pytest.mark.parametrize("shape", [(10, 400), (400, 10), (1, 1)])
def test_summary_fits_maps_of_any_shape(summary, shape):
    grid = OccupancyGrid(np.zeros(shape, np.int8), np.array([0.0, 0.0]), 0.05)
    height, width = summary(grid=grid).shape[:2]
    assert width == 1040
    assert 400 < height < 1500


def test_pictures_are_the_same_bytes_again_and_leave_no_pyplot(summary, tmp_path):
    loaded_before = set(sys.modules)
    cloud = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    colors = height_colors(cloud[:, 2])
    for name in ("a.png", "b.png"):
        summary(name, truth=loop())
        write_cloud_views(tmp_path / f"views_{name}", cloud, colors, loop())
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "views_a.png").read_bytes() == (tmp_path / "views_b.png").read_bytes()
    assert len(list(tmp_path.iterdir())) == 4
    assert "matplotlib.pyplot" not in set(sys.modules) - loaded_before


def test_views_leave_the_ceiling_out(tmp_path):
    side = np.linspace(-2.0, 2.0, 200)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    floor = np.column_stack([x, y, np.zeros_like(x)]).astype(np.float32)
    ceiling = floor + np.float32([0.0, 0.0, 2.5])
    green, magenta = (
        np.full(floor.shape, (20, 180, 20), np.uint8),
        np.full(floor.shape, (250, 0, 250), np.uint8),
    )

    write_cloud_views(
        tmp_path / "v.png", np.concatenate([ceiling, floor]), np.concatenate([magenta, green]), loop()
    )

    picture = cv2.imread(str(tmp_path / "v.png"))
    assert pixels_like(picture, (20, 180, 20)) > 50_000
    assert pixels_like(picture, (250, 0, 250)) == 0


def test_clouds_without_colours_are_coloured_by_height_and_fill_the_page(tmp_path):
    side = np.linspace(-10.0, 10.0, 300)
    x, y = (a.ravel() for a in np.meshgrid(side, 0.2 * side))
    slope = np.column_stack([x, y, 0.1 * x]).astype(np.float32)
    grey = np.full(slope.shape, 90, np.uint8)
    write_cloud_views(tmp_path / "v.png", slope, grey, loop(), has_colors=False)
    write_cloud_views(tmp_path / "grey.png", slope, grey, loop())
    picture = cv2.imread(str(tmp_path / "v.png"))
    assert pixels_like(picture, (90, 90, 90)) < 1000
    below = slope[:, 2] <= 1.5
    for color in height_colors(slope[below, 2][[0, -1]]):
        assert pixels_like(picture, tuple(color.tolist())) > 500
    drawn = (
        np.abs(cv2.imread(str(tmp_path / "grey.png")).astype(int) - BACKDROP[::-1]).max(axis=2) > 20
    ).mean()
    assert drawn > 0.25


def test_the_nearest_point_wins_whatever_the_order():
    near_and_far = np.array([[0.5, 0.5, 1.0], [0.5, 0.5, -1.0]], np.float32)
    red_and_blue = np.array([[255, 0, 0], [0, 0, 255]], np.uint8)
    for order in ([0, 1], [1, 0]):
        image = splat(
            near_and_far[order],
            red_and_blue[order],
            low=np.zeros(2),
            pixel_m=0.1,
            shape=np.array([10, 12]),
        )
        assert image.shape == (10, 12, 3)
        np.testing.assert_array_equal(image[4:7, 4:7], np.broadcast_to([255, 0, 0], (3, 3, 3)))
        assert (image[..., 0] == 255).sum() == 9


def test_points_outside_the_view_are_not_drawn():
    cloud = np.array([[-0.05, 0.5, 0.0], [0.5, 1.05, 0.0], [50.0, 50.0, 0.0]], np.float32)
    white = np.full((3, 3), 255, np.uint8)
    image = splat(cloud, white, low=np.zeros(2), pixel_m=0.1, shape=np.array([10, 10]))
    assert image.max() < 255


def test_height_colours_run_from_blue_to_red():
    colors = height_colors(np.linspace(0.0, 2.0, 500))
    assert colors.shape == (500, 3)
    low, high = colors[50].astype(int), colors[450].astype(int)
    assert low[2] > low[0] + 50
    assert high[0] > high[2] + 50
    assert height_colors(np.empty(0)).shape == (0, 3)
    assert len(np.unique(height_colors(np.full(5, 1.0)), axis=0)) == 1


def uncertain(trajectory, sigmas_m, doubtful=()):
    covariances = np.zeros((len(trajectory), 6, 6))
    covariances[:, 3:, 3:] = np.square(sigmas_m)[:, np.newaxis, np.newaxis] * np.eye(3)
    covariances[np.isnan(sigmas_m)] = np.nan
    is_doubtful = np.zeros(len(trajectory), np.bool_)
    is_doubtful[list(doubtful)] = True
    return UncertainPoses(trajectory, is_doubtful, covariances)


def test_summary_shows_what_is_uncertain_and_what_is_doubtful(summary):
    plain, certain, doubted = (
        summary(poses=poses)
        for poses in (
            None,
            uncertain(loop(), np.full(200, 1e-4)),
            uncertain(loop(), np.linspace(0.0, 0.1, 200), doubtful=range(50, 80)),
        )
    )
    band = tuple(round(60 / 255 * c + 195 / 255 * 255) for c in ESTIMATE)
    assert pixels_like(doubted, band) > 5 * max(pixels_like(certain, band), 100)
    assert pixels_like(doubted, DOUBTFUL) > 500
    assert pixels_like(plain, DOUBTFUL) == pixels_like(certain, DOUBTFUL) == 0


def test_a_band_is_as_wide_as_told_and_has_gaps():
    positions = np.column_stack([np.linspace(0.0, 10.0, 101), np.full(101, 5.0)])
    half_widths_m = np.full(101, 0.5)
    half_widths_m[60:70] = np.nan
    image = band_image(positions, half_widths_m, low=np.zeros(2), high=np.array([10.0, 10.0]))
    painted = image[:, :, 3] > 0
    pixel_m = 10.0 / image.shape[1]
    assert painted[:, 300].sum() * pixel_m == pytest.approx(1.0, abs=0.03)
    assert painted[:, 645].sum() == 0
    assert set(np.unique(image[:, :, 3])) == {0, 60}


def test_a_band_that_is_wider_than_any_image_covers_all():
    image = band_image(np.eye(2), np.array([1.0, 1e9]), low=np.zeros(2), high=np.ones(2))
    assert (image[:, :, 3] > 0).all()


@pytest.mark.filterwarnings("error")
def test_a_name_that_the_font_has_no_letters_for_is_no_warning(tmp_path):
    figure = new_figure(2.0, 1.0)
    figure.text(0.1, 0.5, "日本")
    save(figure, tmp_path / "name.png")
    assert cv2.imread(str(tmp_path / "name.png")) is not None
