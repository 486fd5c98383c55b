"""What verbs print: lines, every row, or one JSON document, by one mechanism."""

import io
import json
import math
import re
import shutil
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
import pytest

from mapper.cli.answer import plain, rows_text
from mapper.cli.console import print_help, print_text
from mapper.cli.groups import PANELS
from mapper.cli.main import app
from mapper.cli.summary import summary_of
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.run.folder import open_run
from mapper.sources.base import later
from tests.support.command_line import invoke, mapper

OF_A_RUN = (
    "run logs frames keyframes factors loops metrics octree cloud_points stage_s total_s frames_per_s "
    "real_time_factor peak_memory_mb resumed files verdict"
)
ANSWERS = {
    "build": (
        ["LOG", "--last", "11", "--out", "TMP/run"],
        OF_A_RUN,
    ),
    "fuse": (
        ["RUN"],
        OF_A_RUN,
    ),
    "loops": (["RUN"], "run loops"),
    "edit": (["RUN"], "run edits"),
    "eval": (["RUN"], "metrics verdict"),
    "export": (["RUN", "--as", "tum"], "path kind"),
    "plan": (
        ["RUN", "--from", "0", "0", "--to", "0.1", "0", "--radius", "0.01", "--unknown", "free"],
        "picture map radius_m unknown length_m min_clearance_m storeys waypoints_world_m",
    ),
    "report": (["RUN", "--out", "TMP/report.html"], "path"),
    "view": (["RUN"], "path"),
    "diff": (
        ["RUN", "RUN", "--place", "built", "--out", "TMP/diff"],
        "path before after T_before_after placed appeared vanished voxels",
    ),
    "merge": (["RUN", "--out", "TMP/map"], "path runs ties left_out summary worker_s shuffle_bytes"),
    "solve": (
        ["RUN/graph.g2o", "--out", "TMP/solved"],
        "path graph config nodes edges loops rejected component_sizes error_before error_after "
        "chi2_per_freedom iterations seconds",
    ),
    "inspect": (["LOG"], "path topics log problem build time_offsets"),
    "convert": (["LOG", "--as", "mbag", "--out", "TMP/log"], "path format frames skipped"),
    "synth": (
        ["TMP/new", "--seconds", "0.1", "--set", "width_px=64", "--set", "texture_px_per_m=8"],
        "path format",
    ),
    "config": ([], "loops octree odometry"),
    "doctor": (["RUN"], "findings"),
    "register": (
        ["LOG@3", "LOG@0", "--method", "gicp"],
        "method trusted reason T_target_source inlier_ratio inlier_rmse_m pairs information stages seconds "
        "target source path",
    ),
    "vocabulary": (
        ["show"],
        "path words branching levels size_bytes trained_on least_weight greatest_weight",
    ),
}
"""Arguments of each verb, and the keys of its document."""

LONG = {"compare", "demo", "localise", "reproduce", "sweep", "sensor"}
"""Verbs that take longer, or need logs of their own; their tests are with what they do."""


def everyone():
    groups = [group.name for group in app.registered_groups]
    return {*(command.name for command in app.registered_commands), *groups}


def test_every_verb_is_tried_here_or_known_to_take_long():
    assert everyone() == {*ANSWERS, *LONG}


@pytest.mark.parametrize("verb", ANSWERS)
def test_json_is_one_document_with_the_keys_of_its_verb(verb, desk_run, desk_log, tmp_path):
    run = tmp_path / "desk"
    shutil.copytree(desk_run.path, run)
    arguments, keys = ANSWERS[verb]
    places = {"LOG": str(desk_log), "RUN": str(run), "TMP": str(tmp_path)}
    for name, place in places.items():
        arguments = [word.replace(name, place) for word in arguments]
    result = mapper(verb, *arguments, "--json")
    document = json.loads(result.stdout)
    assert set(keys.split()) == document.keys() if verb != "config" else set(keys.split()) <= document.keys()
    assert result.stderr == "", "machines read errors there"


def test_a_truth_that_is_near_no_frame_costs_a_run_its_accuracy_alone(desk_run):
    run = open_run(desk_run.path)
    vars(run)["truth"] = later(desk_run.truth, 10**12)
    answer = summary_of(run)
    names = {metric["name"] for metric in answer.document["metrics"]}
    assert all(
        re.search("^accuracy +not known", text, re.MULTILINE) for text in (answer.text, answer.details)
    )
    assert names == {metric.name for metric in evaluate(run.trajectory, None).metrics}


@pytest.mark.parametrize(
    ("arguments", "status", "kind"),
    [
        (["inspect", "NOWHERE"], 1, "SourceError"),
        (["export", "RUN", "--as", "las", "--quiet", "--verbose"], 1, "ConfigError"),
        (["build", "LOG", "--nonsense"], 2, "UsageError"),
        (["sensor", "nonsense"], 2, "UsageError"),
    ],
)
def test_an_error_is_a_document_too(arguments, status, kind, desk_run):
    arguments = [desk_run.path if word == "RUN" else word for word in arguments]
    result = mapper(*arguments, "--json", status=status)
    error = json.loads(result.stdout)["error"]
    assert error["kind"] == kind
    assert result.stderr == f"mapper: {error['message']}\n"
    assert mapper(*arguments, status=status).stdout == ""


def test_an_answer_that_is_an_error_is_one_document(desk_run):
    result = mapper("eval", desk_run.path, "--gate", "ATE RMSE=0", "--json", status=1)
    assert "metrics" in json.loads(result.stdout)


def test_a_log_file_keeps_what_is_printed_with_times(desk_run, tmp_path):
    log = tmp_path / "mapper.log"
    shown = mapper("loops", desk_run.path, "--log-file", log).stdout
    assert mapper("loops", desk_run.path, "--log-file", log, "--quiet").output == ""
    mapper("inspect", tmp_path / "none", "--log-file", log, status=1)
    lines = [
        re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (.*)", line)[1]
        for line in log.read_text().splitlines()
    ]
    printed = [line for line in shown.splitlines() if line]
    assert [line for line in lines if line in printed] == 2 * printed
    assert lines[-1] == f"SourceError: {tmp_path / 'none'}: no such file or folder"
    mapper("inspect", tmp_path / "\udcff", "--log-file", log, status=1)  # a name that is no UTF-8
    assert r"\udcff: no such file or folder" in log.read_text().splitlines()[-1]
    mapper("inspect", tmp_path, "--log-file", tmp_path / "none" / "a.log", status=1)
    for name in ("graph.g2o", "cloud.ply"):
        before = desk_run.file(name).read_bytes()
        refused = mapper("loops", desk_run.path, "--log-file", desk_run.path / name, status=1)
        assert "is no log of mapper" in refused.stderr
        assert desk_run.file(name).read_bytes() == before


def test_verbose_prints_every_row_and_quiet_none_and_progress_is_in_the_log_file(
    desk_log, desk_run, tmp_path
):
    log, build = tmp_path / "mapper.log", ("build", desk_log, "--last", 11, "--out", tmp_path / "run")
    rest = mapper(*build, "--verbose", "--log-file", log).stdout
    for row in ("keyframes", "levelled by", "seconds", "peak memory", "trajectory.tum"):
        assert row in rest
    for row in ("track: 12/12 in", "fuse: 12/12 in", "frames ", "verdict "):
        assert f" {row}" in log.read_text()
    assert mapper("loops", desk_run.path, "--accepted").stdout
    assert mapper("loops", desk_run.path, "--accepted", "--quiet").output == ""
    both = mapper("loops", desk_run.path, "--quiet", "--verbose", status=1)
    assert both.stderr == "mapper: --verbose and --quiet: choose one\n"


def test_values_become_json_without_losing_or_inventing_any():
    @dataclass
    class Inner:
        path: Path

    class Kind(StrEnum):
        ONE = "one"

    document = {"a": np.float64(0.5), "b": math.nan, "c": (Kind.ONE, True, None), "d": Inner(Path("x"))}
    assert plain(document) == {"a": 0.5, "b": None, "c": ["one", True, None], "d": {"path": "x"}}
    assert plain({"rows": np.eye(2, dtype=np.int64)}) == {"rows": [[1, 0], [0, 1]]}
    with pytest.raises(TypeError, match="object"):
        plain(object())


def test_rows_are_aligned_and_folded():
    rows = [("a", "one two three four five"), ("long", "x")]
    assert rows_text(rows, width=26) == "a     one two three four\n      five\nlong  x"


class Screen(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("environment", "coloured"),
    [({"TERM": "xterm"}, True), ({"TERM": "xterm", "NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)],
)
def test_colours_are_for_terminals_that_want_them(monkeypatch, environment, coloured):
    screen = Screen()
    monkeypatch.setattr("sys.stdout", screen)
    monkeypatch.delenv("NO_COLOR", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    print_text("run      a\x1b[2Jb\nverdict  doubtful")
    print_help("Usage: mapper\n\nOptions:\n  -h, --help  Help.\n")
    assert ("\x1b[33mdoubtful\x1b[0m" in screen.getvalue()) is coloured
    assert ("\x1b[1mOptions:\x1b[0m" in screen.getvalue()) is coloured
    assert ("\x1b[36m-h, --help\x1b[0m" in screen.getvalue()) is coloured
    assert ("a\x1b[2Jb" in screen.getvalue()) is not coloured, "escaped by the stream, where there is one"


@pytest.mark.parametrize("help_", ["-h", "--help"])
@pytest.mark.parametrize("words", [[], ["build"], ["sensor"], ["sensor", "depth"], ["vocabulary", "train"]])
def test_help_is_everywhere(words, help_):
    assert mapper(*words, help_).stdout.startswith("Usage: ")


def test_the_verbs_are_listed_by_what_they_are_for_within_a_screen():
    lines = mapper("-h").stdout.splitlines()
    assert tuple(line.split()[0] for line in lines if line[:1].islower()) == PANELS
    assert len(lines) <= 40
    assert max(map(len, lines)) < 80
    assert mapper().stdout == mapper("-h").stdout


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["biuld", "x"], "mapper: no verb 'biuld'; did you mean build?; mapper -h lists them all"),
        (["sensor", "dept"], "mapper: sensor: no verb 'dept'; did you mean depth?; mapper sensor -h lists"),
        (["build"], "mapper: build: missing argument 'LOG'; mapper build -h shows how"),
        (["build", "a", "b"], "mapper: build: does not take b too; want one log: build each, then"),
        (["build", "a", "--ovt"], "mapper: build: no such option: --ovt"),
        (["build", "a", "--first", "x"], "mapper: build: invalid value for '--first'"),
        (["--foo"], "mapper: no such option: --foo; mapper -h shows how"),
        (["pyproject.toml"], "mapper: no verb 'pyproject.toml', but a file or folder: mapper inspect"),
    ],
)
def test_a_slip_of_the_keyboard_is_one_line_with_status_2(words, line):
    result = invoke(*words)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith(line)
    assert len(result.stderr.splitlines()) == 1
