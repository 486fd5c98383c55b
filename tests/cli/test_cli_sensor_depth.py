"""``mapper sensor depth`` from the command line, on walls that ``mapper synth`` made."""

import csv
import json

import pytest

from mapper.config.loading import load_config
from mapper.sources.image_files.reading import read_grey
from tests.support.command_line import mapper

SMALL = ["--seconds", "0.1", "--set", "width_px=160", "--set", "height_px=120", "--set", "texture_px_per_m=8"]
DISTANCES_M = (0.7, 1.3, 2.4)


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walls")
    logs = [folder / f"wall-{distance_m}" for distance_m in DISTANCES_M]
    for log, distance_m in zip(logs, DISTANCES_M, strict=True):
        mapper("synth", log, "--plane-at", distance_m, *SMALL, "--quiet")
    return logs


@pytest.fixture(scope="module")
def measured(walls, tmp_path_factory):
    out = tmp_path_factory.mktemp("sensor") / "kinect"
    planes = [word for distance_m in DISTANCES_M for word in ("--plane-at", distance_m)]
    return out, mapper("sensor", "depth", *walls, *planes, "--out", out)


def test_a_table_and_a_noise_are_printed(measured):
    out, result = measured
    for words in ("Δd mm", "DIF s", "in time", "noise  σ_z = ", f"--config {out / 'sensor.toml'}"):
        assert words in result.stdout
    assert len([line for line in result.stdout.splitlines() if line.startswith(("0.", "1", "2"))]) == 3
    assert "2.4 m: 4/4" in result.stderr


def test_the_numbers_are_kept(measured):
    out, _ = measured
    rows = list(csv.DictReader((out / "depth.csv").open(encoding="utf-8")))
    assert [float(row["distance_m"]) for row in rows] == list(DISTANCES_M)
    for row in rows:
        assert float(row["dif_std_m"]) < float(row["std_m"]) < float(row["max_error_99_m"])
        assert float(row["max_error_99_m"]) <= float(row["max_error_m"])
        assert float(row["temporal_m"]) == pytest.approx(float(row["std_m"]), rel=0.2)
    record = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
    assert record["distances"] == "given"
    assert record["levels"][0]["typical"]["raw"]["std_m"] == float(rows[0]["std_m"])


def test_a_build_reads_the_noise_and_the_pictures_can_be_read(measured):
    out, _ = measured
    record = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
    config = load_config(out / "sensor.toml")
    assert config.odometry.depth_noise.model_dump() == record["noise"]
    assert config.odometry.model_copy(update={"depth_noise": None}) == load_config().odometry
    assert record["noise"]["quadratic_per_m"] == pytest.approx(0.0022, rel=0.25)
    assert read_grey(out / "accuracy.png").shape[1] > 1000
    assert read_grey(out / "residuals.png").shape[0] > 300


def test_the_same_logs_give_the_same_bytes(walls, tmp_path):
    for name in ("a", "b"):
        mapper("sensor", "depth", *walls[:1], "--plane-at", 0.7, "--out", tmp_path / name, "--quiet")
    for path in sorted((tmp_path / "a").iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_without_a_folder_nothing_is_written_and_planes_need_no_distance(walls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = mapper("sensor", "depth", *walls[:2], "--fit-plane", "--stride", 1)
    assert "noise  σ_z = " in result.stdout
    assert "in     " not in result.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give the distance of each LOG's plane with --plane-at, or search for planes with --fit-plane"),
        (["--plane-at", "0.7", "--plane-at", "1"], "1 logs and 2 --plane-at; want one for each log"),
        (["--plane-at", "-1"], "--plane-at -1: want metres before the camera"),
        (["--plane-at", "nan"], "--plane-at nan: want metres before the camera"),
        (["--plane-at", "1", "--fit-plane"], "--plane-at 1.0: has no meaning with --fit-plane"),
        (["--plane-at", "1.5"], "shows a plane at 0.7 m, not at 1.5 m"),
        (["--plane-at", "0.7", "--patch", "1,2,3"], "--patch 1,2,3: want four whole numbers"),
        (["--plane-at", "0.7", "--patch", "100,0,90,9"], "reaches beyond the image of 160×120 px"),
        (["--plane-at", "0.7", "--set", "source.color=1"], "source.color: unknown; "),
        (["--plane-at", "0.7", "--first", "50"], "no frame is left of the range 50"),
        (["--plane-at", "0.7", "--out", "LOG"], "exists already; choose another --out"),
    ],
)
def test_what_cannot_be_measured_is_said_in_one_line(walls, arguments, message):
    given = [str(walls[0]) if word == "LOG" else word for word in arguments]
    result = mapper("sensor", "depth", walls[0], *given, "--quiet", status=1)
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
