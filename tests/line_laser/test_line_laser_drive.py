"""Rendered drives with a line laser: true to their geometry, judged by labels, mapped by the commands."""

import json

import numpy as np
import pytest

from mapper.config.loading import read_config
from mapper.core.errors import SourceError
from mapper.evaluators.sensors import line_laser_study
from mapper.evaluators.sensors.line_laser import TABLE_2_1, count, range_records, read_labels
from mapper.line_laser.calibration import ahead_m
from mapper.line_laser.config import THESIS, LineLaserCalibration, LineLaserConfig, LineLaserSynthConfig
from mapper.line_laser.files import find_images
from mapper.line_laser.rendering import Patch, Room, make_board, make_room, take
from mapper.line_laser.survey import drive, scan_images
from mapper.line_laser.survey import sensor_poses as drive_poses
from mapper.line_laser.synthetic_log import sensor_poses
from mapper.octree.grid import OCCUPIED, read_grid
from mapper.sources.image_files.reading import decode_colour
from tests.support.command_line import invoke

SYNTH = LineLaserSynthConfig(seed=2)
HALF = ("rate_hz=1", "width_px=320", "height_px=180", "focal_px=275")
PLAIN = SYNTH.model_copy(update={"lamps": 0.0, "red_things": 0.0, "dull_things": 0.0})


def shot_of(room, config=PLAIN, T=None, seed=0):
    return take(room, config, np.eye(4) if T is None else T, rng=np.random.default_rng(seed))


@pytest.mark.parametrize("range_m", [0.5, 1.0, 1.7])
def test_the_stripe_lies_where_the_thesis_saw_it(range_m):
    shot = shot_of(make_board(PLAIN, range_m=range_m, width_m=0.3))
    board = np.isclose(shot.ranges_m, range_m)
    assert np.count_nonzero(board) == pytest.approx(0.3 * 550.0 / range_m, abs=1.01)
    assert shot.rows[board] == pytest.approx(179.5 + 550.0 * (0.324 - 0.615 * (1 - range_m / 1.9)) / range_m)
    assert ahead_m(THESIS, shot.rows[board]) == pytest.approx(range_m, rel=0.006)
    assert np.isclose(shot.ranges_m[~board], 1.9).all()  # beside it, the floor

    image = decode_colour(shot.jpeg, "x").astype(int)
    redness = 2 * image[:, :, 0] - image[:, :, 1] - image[:, :, 2]
    column = int(np.flatnonzero(board)[len(np.flatnonzero(board)) // 4])
    rims = np.flatnonzero(redness[:, column] > 0.5 * redness[:, column].max())
    assert rims.mean() == pytest.approx(shot.rows[column], abs=1.0)


def test_walls_hide_each_other_and_what_is_dull_shows_no_stripe():
    ends = np.array([[[1.5, -3.0], [1.5, 3.0]], [[1.0, 0.0], [1.0, 3.0]]])
    dull = Patch(0, (2.0, 2.5), (0.0, 0.6), "dull", (0.0, 0.0, 0.0))  # from y = −1 to −0.5
    shot = shot_of(Room(ends, np.full((2, 3), 0.8), [dull], np.full(3, 0.5)))
    assert shot.ranges_m[:320] == pytest.approx(1.0)
    assert shot.ranges_m[320:502] == pytest.approx(1.5)
    assert np.isnan(shot.ranges_m[504:]).all()
    assert np.isnan(shot.rows[504:]).all()


def test_the_same_seed_is_the_same_image():
    room = make_room(SYNTH)
    first, again, other = (shot_of(room, SYNTH, seed=seed) for seed in (0, 0, 1))
    assert first.jpeg == again.jpeg != other.jpeg
    assert make_room(SYNTH.model_copy(update={"seed": 3})).patches != room.patches


def test_the_way_round_ends_where_it_begins():
    T = sensor_poses(SYNTH).T_world_body
    assert np.linalg.norm(T[-1, :2, 3] - T[0, :2, 3]) < 0.1
    ends = make_room(SYNTH).ends_world
    for pose in T[::10]:
        steps = np.linspace(0.0, 1.0, 101)[:, None, None]
        walls = ends[:, 0] + steps * (ends[:, 1] - ends[:, 0])
        assert np.linalg.norm(walls - pose[:2, 3], axis=2).min() > 0.35


def test_counts_by_hand():
    response = np.zeros((20, 4), np.uint8)
    response[[9, 10, 17], 0] = 50  # the stripe twice, and something else
    response[2, 1] = 50  # wrong
    response[10, 3] = 50  # there is no stripe
    found = count(response, np.array([10.0, 10.0, 10.0, np.nan]), join_px=0)
    assert (found.marked, found.right, found.reached, found.stripe_columns) == (5, 2, 1, 3)
    assert (found.rows, found.right_rows) == (3, 1)
    assert found.columns == pytest.approx((1 / 3, 1 / 3, 1 / 3))
    assert found.pixels == pytest.approx((2 / 5, 1 / 3, 2 * (2 / 15) / (11 / 15)))
    assert (found + found).pixels == found.pixels


def test_ranges_are_compared_with_the_table():
    records = {
        r["range_m"]: r
        for r in range_records(np.array([0.5, 0.52, 1.0, 1.3]), np.array([0.51, 0.52, 0.9, 1.3]))
    }
    assert records[0.5]["columns"] == 2
    assert records[1.0]["median_error_ratio"] == pytest.approx(0.1)
    assert records[1.5]["median_error_ratio"] is None
    assert records[1.7]["thesis_error_ratio"] == pytest.approx(0.0294, abs=1e-4)


@pytest.fixture(scope="module")
def study():
    scenes = {name: line_laser_study.SCENES[name] for name in ("both",)}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(line_laser_study, "SCENES", scenes)
        patched.setattr(line_laser_study, "IMAGES_PER_SCENE", 3)
        yield line_laser_study.study(LineLaserConfig(), [7])


def test_the_combination_finds_the_stripe_better_than_any_method_alone(study):
    records = line_laser_study.detections(study).records
    f_scores = {record["method"]: record["f_score"] for record in records}
    pixels = {record["method"]: record["pixel_f_score"] for record in records}
    assert max(f_scores, key=f_scores.get) == max(pixels, key=pixels.get) == "combined"
    assert f_scores["combined"] > 0.7
    assert {record["method"] for record in records if record["best_in_seeds"]} == {"combined"}


def test_ranges_are_at_least_as_right_as_the_thesis_measured(study):
    for record in line_laser_study.table_2_1(study).records:
        assert record["error_ratio"] <= record["thesis_error_ratio"] + 1e-9
        assert abs(record["measured_m"] - record["range_m"]) < 0.01 * record["range_m"]
        assert record["thesis_measured_m"] == TABLE_2_1[record["range_m"]]


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    folder = tmp_path_factory.mktemp("line_laser")
    half = [word for knob in HALF for word in ("--set", knob)]
    steps = [
        ("synth", folder / "drive", "--sensor", "line-laser", "--seconds", 4, "--seed", 1, *half),
        ("sensor", "line-laser-calibrate", folder / "drive/shots", "--wheelbase", 0.26, "--sensor-x", 0.2),
        ("sensor", "line-laser", folder / "drive/images", "--calibration", folder / "C.toml"),
    ]
    options = [
        (),
        ("--out", folder / "C.toml"),
        (
            "--wheels",
            folder / "drive/encoders.txt",
            "--labels",
            folder / "drive/labels.csv",
            "--out",
            folder / "out",
        ),
    ]
    results = [invoke(*step, *more) for step, more in zip(steps, options, strict=True)]
    assert [result.exit_code for result in results] == [0, 0, 0], [result.output for result in results]
    return folder, [result.stdout for result in results]


def test_the_commands_lead_from_a_drive_to_a_map(driven):
    folder, (made, calibrated, mapped) = driven
    assert "--reach 1.9 --wheelbase 0.26 --sensor-x 0.2" in made
    assert "p^-1.01" in calibrated
    assert mapped.index("combined") < mapped.index("thesis %") < mapped.index("stripe   4 images")
    names = {path.name for path in (folder / "out").iterdir()}
    assert names >= {
        "ranges.csv",
        "map.pgm",
        "map.yaml",
        "map_and_path.png",
        "points.ply",
        "trajectory.txt",
        "local",
    }
    assert len(list((folder / "out/local").iterdir())) == 4
    assert len([name for name in names if name.startswith("detection_")]) == 3

    grid = read_grid(folder / "out/map.yaml")
    rows, columns = np.nonzero(grid.cells == OCCUPIED)
    cells = grid.origin_world_m + (np.column_stack([columns, rows]) + 0.5) * grid.resolution_m
    walls = np.array(json.loads((folder / "drive/scene.json").read_text())["walls_world_m"])
    along = np.linspace(0.0, 1.0, 1001)[:, None, None]
    on_walls = (walls[:, 0] + along * (walls[:, 1] - walls[:, 0])).reshape(-1, 2)
    off_m = np.linalg.norm(cells[:, None] - on_walls, axis=2).min(axis=1)
    assert len(cells) > 50
    assert (off_m < 0.04).mean() > 0.85


def test_the_same_drive_gives_the_same_map(driven):
    folder, _ = driven
    calibration, config = read_config(folder / "C.toml", LineLaserCalibration), LineLaserConfig()
    images, stamps_ns, _ = find_images(folder / "drive/images")
    scans, _ = scan_images(images, stamps_ns, calibration, config)
    wheels, _ = drive_poses(folder / "drive/encoders.txt", calibration)
    again = drive(list(scans.values()), wheels, config.map).grid
    assert (again.cells == read_grid(folder / "out/map.yaml").cells).all()


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("images", "--calibration", "nothing.toml"), "nothing.toml: cannot be read: No such file"),
        (("images", "--wheels", "nothing.txt"), "nothing.txt: cannot be read"),
        (("images", "--labels", "encoders.txt"), "encoders.txt:2: 1 columns, want 4: image,column,row_px"),
        (("shots", "--wheels", "encoders.txt"), "encoders.txt: the wheelbase is unknown"),
        (("nowhere",), "nowhere: no such folder"),
        (("images", "--set", "stripe.edge=1"), "stripe.edge: unknown; "),
        (("images", "--labels", "shots.csv"), "shots.csv: of board.jpg and others"),
    ],
)
def test_mistakes_are_told_in_one_line(driven, monkeypatch, arguments, why):
    folder, _ = driven
    monkeypatch.chdir(folder / "drive")
    (folder / "drive/shots.csv").write_text("board.jpg,1,2,3\n")
    result = invoke("sensor", "line-laser", *arguments, "--out", folder / "wrong", "--quiet")
    assert result.exit_code == 1
    assert why in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (folder / "wrong").exists()


def test_a_calibration_is_not_overwritten_unasked(driven):
    folder, _ = driven
    arguments = ("sensor", "line-laser-calibrate", folder / "drive/shots", "--out", folder / "C.toml")
    assert "C.toml: exists already" in invoke(*arguments).stderr
    (folder / "D.png").touch()
    assert "D.png: exists already" in invoke(*arguments[:-1], folder / "D.toml").stderr
    assert "D.png: the picture's place" in invoke(*arguments[:-1], folder / "D.png", "--overwrite").stderr
    assert not (folder / "D.png").stat().st_size
    beyond = invoke(*arguments, "--overwrite", "--reach", 1.5).stderr
    assert "a board at 1.7 m, but the laser meets the floor at 1.5 m" in beyond
    assert "wheelbase_m: want more than 0" in invoke(*arguments, "--overwrite", "--wheelbase", -1).stderr


def test_labels_that_fit_nothing_are_refused(tmp_path):
    path = tmp_path / "labels.csv"
    path.write_text("image,column,row_px,range_m\na.jpg,3,10.5,1.25\n")
    rows, ranges_m = read_labels(path, images=[path.with_name("a.jpg")], width_px=5)["a.jpg"]
    assert rows[3] == 10.5
    assert ranges_m[3] == 1.25
    assert np.isnan(rows).sum() == 4
    for line, why in (
        ("a.jpg,5,1,1", "column 5, want a whole number from 0 to 4"),
        ("a.jpg,1", "2 columns, want 4"),
    ):
        path.write_text(line)
        with pytest.raises(SourceError, match=why):
            read_labels(path, images=[path.with_name("a.jpg")], width_px=5)


def test_another_sensors_options_are_refused(tmp_path):
    result = invoke("synth", tmp_path / "log", "--sensor", "line-laser", "--rings", 8)
    assert result.exit_code == 1
    assert "--rings 8: has no meaning with --sensor line-laser" in result.stderr
