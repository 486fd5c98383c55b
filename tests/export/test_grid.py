import cv2
import numpy as np
import pytest

from mapper.core.errors import MapFileError
from mapper.export.figures import INK
from mapper.export.grid import write_grid
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, read_grid


@pytest.fixture
def grid():
    cells = np.random.default_rng(0).choice(np.array([UNKNOWN, FREE, OCCUPIED], np.int8), (17, 23))
    return OccupancyGrid(cells, np.array([-1.2500000000000002, 3.05]), 0.05)


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_what_is_written_reads_back_exactly(tmp_path, grid):
    write_grid(tmp_path, "slice", grid)

    got = read_grid(tmp_path / "slice.yaml")

    np.testing.assert_array_equal(got.cells, grid.cells)
    assert got.cells.dtype == np.int8
    np.testing.assert_array_equal(got.origin_world_m, grid.origin_world_m)
    assert got.resolution_m == grid.resolution_m
    assert sorted(path.name for path in tmp_path.iterdir()) == ["slice.pgm", "slice.png", "slice.yaml"]


@pytest.mark.parametrize(("resolution_m", "columns"), [(0.05, 120), (0.2, 900), (0.01, 7)])
def test_the_picture_has_a_bar_of_a_round_length_below_the_map(tmp_path, resolution_m, columns):
    write_grid(
        tmp_path, "m", OccupancyGrid(np.zeros((80, columns), np.int8), np.array([0.0, 0.0]), resolution_m)
    )
    picture = cv2.imread(str(tmp_path / "m.png"))
    enlargement = picture.shape[1] // columns
    below = picture[80 * enlargement :]
    assert (picture[: 80 * enlargement] == 255).all()  # free
    bar_px = (below[18] == INK[::-1]).all(axis=1)
    length_m = (np.argmin(bar_px[10:]) - 1) * resolution_m / enlargement
    leading = length_m / 10 ** np.floor(np.log10(1.02 * length_m))
    assert min(abs(leading - step) for step in (1.0, 2.0, 5.0)) < 0.1
    assert 0.08 < length_m / (columns * resolution_m) < 0.27


def test_the_pgm_is_the_one_map_server_saves(tmp_path):
    cells = np.array([[FREE, OCCUPIED, UNKNOWN], [OCCUPIED, OCCUPIED, FREE]], np.int8)
    write_grid(tmp_path, "m", OccupancyGrid(cells, np.array([0.0, 0.0]), 0.05))

    data = (tmp_path / "m.pgm").read_bytes()

    top_row, bottom_row = bytes([0, 0, 254]), bytes([254, 0, 205])  # the top row is max y
    assert data == b"P5\n# CREATOR: mapper 0.050 m/pix\n3 2\n255\n" + top_row + bottom_row


def test_the_yaml_says_what_nav2_wants(tmp_path, grid):
    write_grid(tmp_path, "slice", grid)
    assert (tmp_path / "slice.yaml").read_text().splitlines() == [
        "image: slice.pgm",
        "mode: trinary",
        "resolution: 0.05",
        "origin: [-1.2500000000000002, 3.05, 0.0]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.196",
    ]


def test_the_picture_is_large_and_the_right_way_up(tmp_path):
    cells = np.full((4, 8), UNKNOWN, np.int8)
    cells[0, 0], cells[3, 7] = OCCUPIED, FREE
    write_grid(tmp_path, "m", OccupancyGrid(cells, np.array([0.0, 0.0]), 0.05))

    picture = cv2.imread(str(tmp_path / "m.png"))
    picture = picture[:500]  # the scale and the legend are below

    assert picture.shape == (500, 1000, 3)
    assert picture[-1, 0].max() < 70  # lowest y, lowest x: dark
    assert picture[0, -1].min() == 255  # highest y, highest x: white
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 3


def test_reading_follows_nav2_where_files_differ_from_ours(tmp_path, grid):
    write_grid(tmp_path, "slice", grid)
    path = tmp_path / "slice.yaml"

    edit(path, "free_thresh: 0.196", "free_thresh: 0.25")  # the known trap: unknown loads as free
    np.testing.assert_array_equal(read_grid(path).cells == FREE, grid.cells != OCCUPIED)

    edit(path, "free_thresh: 0.25", "free_thresh: 0.196  # safe")
    edit(path, "negate: 0", "negate: 1")
    np.testing.assert_array_equal(read_grid(path).cells == FREE, grid.cells == OCCUPIED)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("resolution: 0.05", "resolution: fine", "fine"),
        ("resolution: 0.05\n", "", "resolution"),
        ("mode: trinary", "mode: raw", "only trinary"),
        ("3.05, 0.0]", "3.05, 1.57]", "turned maps"),
        ("slice.pgm", "lost.pgm", r"lost\.pgm: cannot be read"),
        ("slice.pgm", "short.pgm", "not a grey 8-bit image"),
        ("slice.pgm", "empty.pgm", "not a grey 8-bit image"),
        ("slice.pgm", "slice.yaml", "not a grey 8-bit image"),
    ],
)
def test_damaged_maps_get_one_clear_line(tmp_path, grid, old, new, complaint):
    write_grid(tmp_path, "slice", grid)
    (tmp_path / "short.pgm").write_bytes((tmp_path / "slice.pgm").read_bytes()[:-5])
    (tmp_path / "empty.pgm").touch()
    edit(tmp_path / "slice.yaml", old, new)
    with pytest.raises(MapFileError, match=complaint) as caught:
        read_grid(tmp_path / "slice.yaml")
    assert "\n" not in str(caught.value)


def test_a_missing_map_is_named(tmp_path):
    with pytest.raises(MapFileError, match=r"no\.yaml: cannot be read"):
        read_grid(tmp_path / "no.yaml")
