"""The line-laser sensor: methods, laws, ranges, local grid and map, each against what is known exactly."""

import cv2
import numpy as np
import pytest

from mapper.config.loading import read_config
from mapper.core.errors import ConfigError, DataError, MapSizeError, SourceError
from mapper.core.geometry import transform
from mapper.line_laser import detection
from mapper.line_laser.calibration import (
    Board,
    CalibrationShot,
    ahead_m,
    calibrate,
    calibration_text,
    find_board,
    right_m,
    row_px,
)
from mapper.line_laser.config import THESIS, LineLaserCalibration, LineLaserConfig, VehicleConfig
from mapper.line_laser.files import find_images, read_shots
from mapper.line_laser.ranging import line_scan, local_grid, scan_image
from mapper.line_laser.survey import drive, map_scans, scan_images, sensor_poses
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN
from tests.support.grids import state_at

CONFIG = LineLaserConfig()
GREY = np.full((360, 640, 3), 90, np.uint8)


def lit(*stripes, image=GREY):
    """Paint red lines of three rows, (first column, last column, row)."""
    painted = image.copy()
    for first, last, row in stripes:
        painted[row - 1 : row + 2, first : last + 1] = (250, 90, 90)
    return painted


@pytest.mark.parametrize(
    ("rgb", "between_deg", "kept"),
    [
        ((200, 20, 20), (355.0, 10.0), 200),
        ((200, 20, 50), (355.0, 10.0), 0),  # 350°
        ((200, 60, 20), (355.0, 10.0), 0),  # 13°
        ((200, 190, 190), (355.0, 10.0), 0),  # of hardly any hue
        ((20, 200, 20), (100.0, 140.0), 200),
        ((200, 20, 20), (100.0, 140.0), 0),
    ],
)
def test_hue_keeps_a_part_of_the_circle(rgb, between_deg, kept):
    image = np.array([[rgb]], np.uint8)
    assert detection.hue(image, from_deg=between_deg[0], to_deg=between_deg[1], saturation=64) == kept


def test_the_other_methods_see_what_is_bright_what_is_red_and_lines_of_some_contrast():
    red = np.array([[0, 249, 250, 255]], np.uint8)
    assert detection.intensity(red, threshold=250).tolist() == [[0, 0, 250, 255]]
    colours = [[200, 50, 60], [100, 60, 60], [100, 90, 75], [50, 200, 200], [255, 255, 255]]
    assert detection.weight(np.array([colours], np.uint8), threshold=40).tolist() == [[255, 80, 0, 0, 0]]
    for levels, is_edge in ((0, False), (8, False), (40, True)):
        line = np.full((41, 41), 100, np.uint8)
        line[19:22] += np.uint8(levels)
        assert (detection.edges(line, sigma_px=1.5, threshold=150)[20, 20] > 0) == is_edge


def test_the_combination_is_the_larger_of_two_where_there_are_edges():
    image = lit((0, 639, 200))
    image[20:60, 100:200] = (200, 40, 40)  # red and wide: the middle has no edges
    image[20:60, 300:400] = 255  # a lamp
    found = detection.responses(image, CONFIG.stripe)
    assert (found["union"] == np.maximum(found["weight"], found["intensity"])).all()
    assert (found["combined"] == np.where(found["edges"] > 0, found["union"], 0)).all()
    assert found["weight"][40, 150]
    assert found["intensity"][40, 350]
    assert not found["edges"][[40, 40], [150, 350]].any()
    assert (detection.stripe_rows(found["combined"], join_px=6)[420:] == 200.0).all()


def test_the_row_is_the_centre_of_mass_of_the_strongest_run():
    response = np.zeros((30, 5), np.uint8)
    response[[3, 4], 0] = 10, 30
    response[[3, 20, 21], 1] = 100, 60, 60
    response[[5, 9], 2] = 50, 50  # both rims of a stripe that is burnt in
    response[29, 3] = response[0, 4] = 7  # neighbours in memory only
    rows = detection.stripe_rows(response, join_px=3)
    assert rows.tolist() == [3.75, 20.5, 7.0, 29.0, 0.0]
    assert detection.stripe_rows(response, join_px=2)[2] in (5.0, 9.0)
    assert np.isnan(detection.stripe_rows(np.zeros((4, 3), np.uint8), join_px=3)).all()


def test_the_thesis_laws_give_the_thesis_figures():
    rows = 360 - 0.5 - 3.6 * np.array([100.0, 50.0, 23.92])  # p on a scale of 100 from the bottom
    assert ahead_m(THESIS, rows) == pytest.approx([0.4461, 0.9004, 1.9], abs=5e-4)
    assert row_px(THESIS, 1.2) == pytest.approx(
        float(np.interp(1.2, ahead_m(THESIS, np.arange(359.0)), np.arange(359.0))), abs=0.01
    )
    x, y = 100.0, 180.0
    assert right_m(THESIS, np.array([319.5 + x]), np.array([359.5 - y])) == pytest.approx(
        0.01 * x / (0.0447 * y - 1.4267)
    )


def exact_shots(ranges_m, *, noise_px=0.0, rng=None):
    shots = []
    for range_m in ranges_m:
        row = row_px(THESIS, range_m)
        px_per_cm = THESIS.lateral.slope * (359.5 - row) + THESIS.lateral.offset
        row += 0.0 if rng is None else float(rng.normal(0.0, noise_px))
        shots.append(CalibrationShot(Board(row, round(40.0 * px_per_cm)), range_m, 0.4))
    return shots


RANGES_M = np.arange(0.5, 1.8, 0.2).round(6)
SIZE = {"size_px": (640, 360), "reach_m": 1.9, "vehicle": VehicleConfig(wheelbase_m=0.26)}


def test_the_fit_recovers_the_law_and_knows_its_doubt():
    found = calibrate(exact_shots(RANGES_M), **SIZE)
    assert found.calibration.range.scale_mm == pytest.approx(47366.0, rel=1e-6)
    assert found.calibration.range.exponent == pytest.approx(-1.013, abs=1e-9)
    assert found.calibration.lateral.slope == pytest.approx(0.0447, rel=0.01)
    assert found.calibration.lateral.offset == pytest.approx(-1.4267, abs=0.05)
    assert np.abs(found.range_errors_m).max() < 1e-9
    (slope_variance, _), (_, offset_variance) = found.calibration.lateral.covariance
    assert slope_variance < offset_variance  # px/cm per px, and px/cm

    rng = np.random.default_rng(0)
    fits = [calibrate(exact_shots(RANGES_M, noise_px=1.0, rng=rng), **SIZE).calibration for _ in range(150)]
    spread = np.std([fit.range.exponent for fit in fits])
    told = np.sqrt(np.mean([fit.range.covariance[1][1] for fit in fits]))
    assert told == pytest.approx(spread, rel=0.3)


@pytest.mark.parametrize(
    ("shots", "why"),
    [
        (exact_shots([0.5, 0.5, 0.7]), "2 different ranges, want 3"),
        (
            [CalibrationShot(shot.board, shot.range_m) for shot in exact_shots(RANGES_M)],
            "0 different ranges of a board",
        ),
        (
            [
                CalibrationShot(a.board, b.range_m, 0.4)
                for a, b in zip(exact_shots(RANGES_M), exact_shots(RANGES_M)[::-1], strict=True)
            ],
            "are ranges and images paired rightly",
        ),
    ],
)
def test_shots_that_give_no_law_are_refused(shots, why):
    with pytest.raises(DataError, match=why):
        calibrate(shots, **SIZE)
    with pytest.raises(DataError, match="want both > 0"):
        CalibrationShot(Board(10.0, 5), -1.0)
    with pytest.raises(DataError, match="does not show it whole"):
        CalibrationShot(Board(10.0, None), 1.0, 0.4)


@pytest.mark.parametrize(
    ("before", "after", "why"),
    [
        ("exponent = -1.013", "exponent = 1.013", "range.exponent: want less than 0"),
        ("slope = 0.0447\n", "", "lateral.slope: want a value, which is missing"),
        ("offset = -1.4267", "offset = -9.0", r"-5.15 px/cm at reach_m = 1.9, want > 0"),
        ("width_px", "widht_px", "widht_px: unknown; did you mean width_px|width_px: want a value"),
    ],
)
def test_a_calibration_file_is_checked(tmp_path, before, after, why):
    text, path = calibration_text(THESIS), tmp_path / "C.toml"
    path.write_text(text)
    assert read_config(path, LineLaserCalibration) == THESIS
    assert before in text
    path.write_text(text.replace(before, after))
    with pytest.raises(ConfigError, match=rf"C.toml: .*({why})"):
        read_config(path, LineLaserCalibration)


def test_a_board_is_the_level_stripe_in_the_middle():
    board = find_board(lit((0, 199, 300), (200, 459, 150), (460, 639, 300)), CONFIG.stripe)
    assert board.row_px == pytest.approx(150.0, abs=0.05)
    assert board.width_px == pytest.approx(260, abs=4)
    assert find_board(lit((0, 639, 150)), CONFIG.stripe).width_px is None
    assert find_board(GREY, CONFIG.stripe) is None
    assert find_board(lit((0, 100, 150)), CONFIG.stripe) is None


def test_a_scan_has_the_left_on_the_left_and_knows_the_floor():
    rows = np.full(640, np.nan)
    rows[[100, 320, 500]] = row_px(THESIS, 1.0), row_px(THESIS, 0.5), row_px(THESIS, 1.9)
    scan = line_scan(rows, THESIS, CONFIG.map, stamp_ns=7)
    assert scan.columns.tolist() == [100, 320, 500]
    assert scan.points_sensor[:, 0] == pytest.approx([1.0, 0.5, 1.9])
    assert scan.points_sensor[0, 1] > 0.2 > abs(scan.points_sensor[1, 1])
    assert scan.points_sensor[2, 1] < -0.5
    assert scan.is_floor.tolist() == [False, False, True]


def test_what_is_seen_below_the_floor_is_no_stripe():
    floor_row = round(row_px(THESIS, 1.9))
    image = lit((0, 639, floor_row + 30), (0, 299, 200))
    image[floor_row + 27 : floor_row + 34, :, 0] = 255  # brighter than the true one
    scan = scan_image(image, THESIS, CONFIG, stamp_ns=0)
    assert scan.columns.max() < 305
    assert np.median(scan.rows_px) == pytest.approx(200.0, abs=0.1)
    with pytest.raises(DataError, match="image of 640×200 px, but the calibration is for 640×360"):
        scan_image(image[:200], THESIS, CONFIG, stamp_ns=0)


def scan_at(*points, floor=(), columns=None):
    rows = np.full(640, np.nan)
    scan = line_scan(rows, THESIS, CONFIG.map, stamp_ns=0)
    return type(scan)(
        0,
        np.arange(len(points)) if columns is None else np.array(columns),
        np.zeros(len(points)),
        np.array(points, float).reshape(-1, 2),
        np.isin(np.arange(len(points)), floor),
    )


def test_the_local_grid_has_the_vehicle_at_the_middle_of_row_zero():
    D = local_grid(
        scan_at((0.505, -0.105), (1.005, 0.995), (1.85, 0.0), (3.0, 0.0), (1.0, 5.0), floor=[2]), CONFIG.map
    )
    assert D.shape == (190, 240)
    assert np.argwhere(D).tolist() == [[50, 120 + 10], [100, 120 - 100]]
    smaller = CONFIG.map.model_copy(update={"width_cells": 40, "depth_cells": 120})
    scan = scan_at((0.505, -0.105), (1.005, 0.995), (1.505, 0.0))
    assert np.argwhere(local_grid(scan, smaller)).tolist() == [[50, 20 + 10]]


WALL = [(1.01, y) for y in np.linspace(0.4, -0.4, 81)]


def test_a_wall_is_occupied_and_what_lies_before_it_free():
    grid = map_scans([scan_at(*WALL)], np.eye(4)[None], CONFIG.map)
    assert state_at(grid, 1.01, 0.0) == state_at(grid, 1.01, 0.3) == OCCUPIED
    assert state_at(grid, 0.5, 0.0) == state_at(grid, 0.97, 0.3) == FREE
    assert state_at(grid, 1.05, 0.0) == state_at(grid, 0.5, 0.35) == UNKNOWN

    floor = map_scans([scan_at(*WALL, floor=range(81))], np.eye(4)[None], CONFIG.map)
    assert not (floor.cells == OCCUPIED).any()
    assert state_at(floor, 0.97, 0.3) == FREE

    apart = map_scans(
        [scan_at((1.0, 0.4), (1.0, 0.39), (1.0, -0.39), (1.0, -0.4), columns=[0, 1, 600, 601])],
        np.eye(4)[None],
        CONFIG.map,
    )
    assert state_at(apart, 0.9, 0.355) == FREE
    assert state_at(apart, 0.9, 0.0) == UNKNOWN


@pytest.mark.parametrize(("misses", "state"), [(2, OCCUPIED), (3, FREE)])
def test_seen_through_often_enough_a_cell_is_free(misses, state):
    farther = [(1.51, 1.5 * y) for _, y in WALL]
    scans = [scan_at(*WALL)] + [scan_at(*farther)] * misses
    assert state_at(map_scans(scans, np.array([np.eye(4)] * len(scans)), CONFIG.map), 1.01, 0.1) == state


def test_maps_that_cannot_be_are_refused():
    far = transform(np.eye(3), np.array([1e4, 1e4, 0.0]))
    with pytest.raises(MapSizeError, match="are the wheels right"):
        map_scans([scan_at(*WALL)] * 2, np.array([np.eye(4), far]), CONFIG.map)
    with pytest.raises(DataError, match="no image shows a stripe"):
        map_scans([scan_at()], np.eye(4)[None], CONFIG.map)


def write_image(path, image):
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), image[:, :, ::-1])


@pytest.fixture
def folder(tmp_path):
    for second in range(4):
        write_image(tmp_path / f"images/100{second}.500000.png", lit((0, 639, 200)))
    return tmp_path


def test_images_come_with_the_stamps_of_their_names_or_of_a_list(folder):
    images, stamps_ns, notes = find_images(folder / "images")
    assert [path.name for path in images] == [f"100{second}.500000.png" for second in range(4)]
    assert stamps_ns.tolist() == [1_000_500_000_000 + second * 10**9 for second in range(4)]
    assert not notes
    (folder / "list.txt").write_text("4\n3\n2\n1\n")
    images, stamps_ns, notes = find_images(folder / "images", times=folder / "list.txt")
    assert images[0].name == "1003.500000.png"
    assert stamps_ns[0] == 10**9
    assert "out of time order" in notes[0]
    (folder / "list.txt").write_text("4\n3\n")
    with pytest.raises(SourceError, match=r"2 stamps for 4 images; .* \(--times names another list\)"):
        find_images(folder / "images", times=folder / "list.txt")
    with pytest.raises(SourceError, match=r"no images; want files ending in .*; those in images/\?"):
        find_images(folder)
    with pytest.raises(SourceError, match="no such folder"):
        find_images(folder / "imagse")


def test_a_damaged_image_is_left_out_and_told(folder):
    images, stamps_ns, _ = find_images(folder / "images")
    images[1].write_bytes(b"no image")
    scans, notes = scan_images(images, stamps_ns, THESIS, CONFIG)
    assert list(scans) == [images[0], *images[2:]]
    assert len(notes) == 1
    assert "1001.500000.png" in notes[0]
    for path in images:
        path.write_bytes(b"")
    with pytest.raises(SourceError, match=r"1000.500000.png: empty file; left out; nor can the other 3"):
        scan_images(images, stamps_ns, THESIS, CONFIG)


def test_images_are_placed_by_the_wheels(folder):
    images, stamps_ns, _ = find_images(folder / "images")
    scans = list(scan_images(images, stamps_ns, THESIS, CONFIG)[0].values())
    calibration = THESIS.model_copy(update={"vehicle": VehicleConfig(wheelbase_m=0.26, sensor_x_m=0.2)})
    encoders = folder / "readings.txt"
    encoders.write_text("".join(f"{1001 + 0.1 * k:.1f} {0.05 * k:.2f} 0\n" for k in range(30)))
    driven = drive(scans, sensor_poses(encoders, calibration)[0], CONFIG.map)
    assert driven.trajectory.positions_world[:, 0] == pytest.approx([0.2 + 0.25, 0.2 + 0.75, 0.2 + 1.25])
    assert any("no wheel pose for 1 images" in note for note in driven.notes)
    wall_m = ahead_m(THESIS, np.array([200.0]))[0]
    assert state_at(driven.grid, 0.45 + wall_m, 0.0) == OCCUPIED

    encoders.write_text("".join(f"{1001 + 0.4 * k:.1f} {0.2 * k:.2f} 0\n" for k in range(8)))
    assert len(drive(scans, sensor_poses(encoders, calibration)[0], CONFIG.map).trajectory) == 3
    strict = CONFIG.map.model_copy(update={"max_wheel_gap_s": 0.3})
    with pytest.raises(DataError, match="no image was taken between two of their readings"):
        drive(scans, sensor_poses(encoders, calibration)[0], strict)

    with pytest.raises(SourceError, match=r"readings.txt: the wheelbase is unknown"):
        sensor_poses(encoders, THESIS)
    encoders.write_text("5.0 0 0\n6.0 0.1 0\n")
    with pytest.raises(DataError, match=r"images begin at 1000.500000 s, readings at 5.000000 s: are they"):
        drive(scans, sensor_poses(encoders, calibration)[0], CONFIG.map)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("a.png", "1 columns, want image,range_m"),
        ("a.png,x", "could not convert"),
        ("a.png,-1", "want a range and a width in metres, both > 0"),
        ("a.png,", "want a range and a width in metres, both > 0"),
        ("b.png,1.0", "b.png: cannot be read: No such file"),
        ("a.png,1.0\nsmall.png,1.2", "image of 100×360 px, but those above are 640×360"),
    ],
)
def test_shots_name_the_line_that_is_wrong(tmp_path, line, why):
    write_image(tmp_path / "a.png", lit((200, 459, 150)))
    write_image(tmp_path / "small.png", GREY[:, :100])
    (tmp_path / "shots.csv").write_text(f"image,range_m,width_m\n{line}\n")
    with pytest.raises(SourceError, match=why):
        read_shots(tmp_path, CONFIG.stripe)


def test_shots_that_show_less_than_they_should_are_told(tmp_path):
    write_image(tmp_path / "whole.png", lit((200, 459, 150)))
    write_image(tmp_path / "wide.png", lit((0, 639, 150)))
    write_image(tmp_path / "dark.png", GREY)
    (tmp_path / "shots.csv").write_text(
        "whole.png,0.9,0.4\nwide.png,0.9,2.0\nwide.png,0.9\ndark.png,1.1,0.4\n"
    )
    shots, size_px, notes = read_shots(tmp_path / "shots.csv", CONFIG.stripe)
    assert size_px == (640, 360)
    assert [shot.width_m for shot in shots] == [0.4, None, None]
    assert len(notes) == 2
    assert "the board leaves wide.png" in notes[0]
    assert "dark.png shows no level stripe" in notes[1]


@pytest.mark.parametrize(
    ("method", "setting", "value"),
    [
        ("hue", "hue_from_deg", 359.0),
        ("hue", "hue_to_deg", 0.5),
        ("hue", "saturation_threshold", 200),
        ("intensity", "intensity_threshold", 251),
        ("weight", "weight_threshold", 250),
        ("edges", "edge_threshold", 255),
        ("edges", "edge_sigma_px", 6.0),
    ],
)
def test_each_threshold_of_the_stripe_belongs_to_one_method(method, setting, value):
    image = np.full((60, 80, 3), 60, np.uint8)
    image[9:12] = (85, 60, 60)  # of little contrast
    image[29:32] = (250, 130, 125)  # of hue 2.4°
    image[29:32, 40:] = (250, 125, 130)  # of hue 357.6°
    stricter = CONFIG.stripe.model_copy(update={setting: value})
    before, after = (detection.responses(image, config) for config in (CONFIG.stripe, stricter))
    assert np.count_nonzero(after[method]) < np.count_nonzero(before[method])
    others = {"hue", "intensity", "weight", "edges"} - {method}
    assert all(np.array_equal(after[other], before[other]) for other in others)


def test_the_floor_begins_a_margin_before_the_reach():
    rows = np.array([row_px(THESIS, range_m) for range_m in (1.7, 1.79, 1.83, 1.89)])
    for margin_m, is_floor in ((0.08, [False, False, True, True]), (0.15, [False, True, True, True])):
        config = CONFIG.map.model_copy(update={"floor_margin_m": margin_m})
        assert line_scan(rows, THESIS, config, stamp_ns=0).is_floor.tolist() == is_floor
