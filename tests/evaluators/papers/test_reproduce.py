"""``mapper reproduce`` on small logs that are called like the papers' sequences."""

import csv
import json
import pickle

import numpy as np
import pytest

from mapper.core.errors import ConfigError, DataError, RunError, SourceError
from mapper.evaluators.papers.paper import Cut
from mapper.evaluators.papers.reproduce import Request, reproduce
from mapper.evaluators.papers.thesis import ThesisJob
from mapper.evaluators.papers.zhao import TABLES, ZhaoJob
from tests.support.command_line import mapper


@pytest.fixture
def logs(desk_log, tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "rgbd_dataset_freiburg1_xyz").symlink_to(desk_log)
    return folder


def test_the_thesiss_tables_are_measured_once_and_written_whole(logs, tmp_path, monkeypatch):
    out = tmp_path / "out"
    command = ("reproduce", "thesis", "--logs", logs, "--out", out, "--tables", "5.2", "--seeds", "2")
    first = mapper(*command, "--last", "9", "--processes", "1")

    assert "Table 5.2" in first.stdout
    assert "fr1/rpy" in first.stdout  # not at hand
    assert first.stdout.count("in part") >= 5
    with (out / "tables.csv").open() as file:
        assert len(list(csv.DictReader(file))) >= 5
    assert {"tables.md", "tables.tex", "cells", "reproduce.json"} <= {path.name for path in out.iterdir()}
    kept = {path.name: path.read_bytes() for path in (out / "cells").iterdir()}
    assert len(kept) == 2
    by_seed = [[record["value"] for record in json.loads(text)["records"]] for text in kept.values()]
    assert by_seed[0] != by_seed[1]
    assert np.abs(np.subtract(*by_seed)).max() < 0.005

    monkeypatch.setattr(ThesisJob, "__call__", None)
    again = mapper(*command, "--last", "9", "--processes", "1")

    assert again.stdout == first.stdout
    assert {path.name: path.read_bytes() for path in (out / "cells").iterdir()} == kept


def test_measurements_travel_to_other_processes(desk_log, tmp_path):
    for job in (
        ThesisJob("fr1/xyz", desk_log, 1, Cut(0, 9), ("5.1", "5.2"), tmp_path),
        ZhaoJob("fr1/xyz", desk_log, 1, Cut()),
    ):
        assert pickle.loads(pickle.dumps(job)) == job


def test_a_log_that_fails_is_listed_and_the_others_are_measured(logs, tiny_tum_log, tmp_path):
    broken = tiny_tum_log()
    (broken / "groundtruth.txt").unlink()
    given = {"fr1/desk": broken}

    reproduction = reproduce(
        Request("thesis", logs, given, ("5.2",), seeds=1, cut=Cut(0, 9)), tmp_path / "out"
    )

    (table,) = reproduction.tables
    by_row = {cell.row: cell for cell in table.cells}
    assert by_row["fr1/xyz"].verdict == "in part"
    assert by_row["fr1/desk"].verdict == "failed"
    assert "no ground truth" in by_row["fr1/desk"].failures[0]
    assert "fr1/desk" not in reproduction.missing
    assert "no ground truth" in (tmp_path / "out/tables.md").read_text()
    with pytest.raises(DataError, match=r"nothing could be measured.*no ground truth"):
        reproduce(Request("thesis", broken.parent / "log", {"fr1/rpy": broken}, ("5.2",)), tmp_path / "bad")


def test_zhaos_tables_come_from_one_run(logs, tmp_path):
    reproduction = reproduce(Request("zhao", logs, seeds=1, cut=Cut(0, 11)), tmp_path / "out")

    run_time, error, size = reproduction.tables
    assert [(cell.column, cell.published) for cell in error.cells] == [
        ("Zhao", 0.009708),
        ("ORB-SLAM2", 0.010084),
        ("RGB-D SLAMv2", 0.019186),
    ]
    assert [cell.verdict for cell in run_time.cells] == ["in part", "not run", "not run"]
    assert 0.0 < error.cells[0].ours[0] < 0.02
    assert [cell.column for cell in size.cells] == ["dense cloud", "octree 0.05 m"]
    assert size.cells[0].ours[0] > size.cells[1].ours[0] > 0.0
    assert reproduction.missing == ("fr1/desk2", "fr1/room")
    assert any("Another machine" in note for note in run_time.notes)
    assert any("s of CPU time on" in note for note in run_time.notes)


def test_zhaos_settings_are_as_published(desk_log):
    (config,) = ZhaoJob("fr1/xyz", desk_log, 5, Cut()).configs().values()

    assert config.octree.resolution_m == 0.05
    assert config.odometry.kind == "pnp"
    assert (config.odometry.ransac_seed, config.loops.verification.match.seed) == (5, 5)
    assert [table.key for table in TABLES.values()] == ["zhao_runtime", "zhao_ape", "zhao_map_size"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--tables", "5.1,9.9"), "--tables 9.9: thesis has 4.1, 4.2, 5.1, 5.2, 5.5, detectors"),
        (("--log", "fr1"), "--log fr1: want NAME=PATH"),
        (("--log", "fr1/none=x"), "no sequence of the paper"),
        (("--log", "fr1/xyz=a", "--log", "fr1/xyz=b"), "fr1/xyz is a already"),
        (("--seeds", "0"), "want at least 1"),
        (("--first", "5", "--last", "3"), "want 0 ≤ first ≤ last"),
        (("--processes", "0"), "--processes 0: want at least 1"),
        (("--scheduler", "tcp://x", "--processes", "2"), "has no meaning with --scheduler"),
    ],
)
def test_a_mistake_is_one_line(logs, tmp_path, options, said):
    result = mapper("reproduce", "thesis", "--logs", logs, "--out", tmp_path / "out", *options, status=1)

    assert said in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_without_logs_is_one_line_and_leaves_nothing(tmp_path):
    (tmp_path / "empty").mkdir()

    with pytest.raises(SourceError, match=r"none of the sequences.*fr1/desk2, fr1/xyz, fr1/room"):
        reproduce(Request("zhao", tmp_path / "empty"), tmp_path / "out")
    with pytest.raises(SourceError, match=r"no pairs\.toml"):
        reproduce(Request("hough", tmp_path / "empty"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(ConfigError, match="hough has one table"):
        Request("hough", tmp_path, tables=("1",))


def test_a_folder_of_something_else_is_left_alone(logs, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.doc").write_text("years of work")

    with pytest.raises(RunError, match=r"holds something else \(no reproduce\.json\)"):
        reproduce(Request("thesis", logs), tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.doc"]
