import csv
import io
import json
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.util import find_spec

import numpy as np
import pytest

from mapper.cli.console import Bars, Lines
from mapper.cli.main import app
from mapper.cli.summary import short_text
from mapper.evaluators.metrics.evaluate import assess, evaluate
from mapper.run.folder import open_run
from mapper.sources import open_source
from mapper.sources.trajectory_files import read_tum
from tests.support.command_line import HEAVY, mapper

VERBS = [
    *((command.name,) for command in app.registered_commands),
    *(
        (group.name, command.name)
        for group in app.registered_groups
        for command in group.typer_instance.registered_commands
    ),
]


@pytest.fixture
def run_folder(desk_run):
    return desk_run.path


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_every_verb_has_help_with_an_example(verb):
    assert f"Example: mapper {' '.join(verb)} " in mapper(*verb, "--help").stdout


VIEWERS_AND_PEERS = {"open3d", "kiss_icp", "kiss_matcher", "rerun", "laspy"}
COMPILER_AND_SOLVER = {"numba", "gtsam", "scipy", "matplotlib", "open3d", "rerun"}


@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        (["--help"], HEAVY),
        (["build", "LOG", "--out", "run", "--last", "11", "--quiet"], VIEWERS_AND_PEERS),
        (["export", "RUN", "--as", "tum", "--quiet"], COMPILER_AND_SOLVER),
        (["loops", "RUN", "--quiet"], COMPILER_AND_SOLVER),
    ],
)
def test_a_verb_loads_only_what_it_needs(run_folder, desk_log, tmp_path, arguments, absent):
    code = "import sys; from mapper.cli.main import app; app(standalone_mode=False); print(*sys.modules)"
    places = {"LOG": desk_log, "RUN": run_folder}
    words = [places.get(word, word) for word in arguments]
    ran = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert not ran.stderr
    assert not absent & {name.split(".")[0] for name in ran.stdout.split()}


def test_build_prints_a_table(desk_log, tmp_path):
    cut = ("--first", 3, "--last", 5, "--stride", 2, "--set", "source.last_frame=24")  # spelled out, it wins
    result = mapper("build", desk_log, "--out", tmp_path / "run", *cut)

    lines = result.stdout.splitlines()
    names = ["frames", "loops", "accuracy", "map", "speed", "run", "verdict", "next"]
    assert [line.split()[0] for line in lines] == names
    assert "11 tracked, 0 doubtful, 0 lost, 0 skipped" in lines[0]
    assert "ATE RMSE, SE(3)-aligned 0.00" in lines[2]
    assert lines[-1].split("  ")[-1].strip() == f"mapper view {tmp_path / 'run'}"
    source = open_run(tmp_path / "run").config.source
    assert (source.first_frame, source.last_frame, source.stride, source.require_truth) == (3, 24, 2, False)


def test_a_profiled_build_tells_what_a_frame_costs(desk_log, tmp_path):
    out = tmp_path / "run"
    answer = json.loads(mapper("build", desk_log, "--out", out, "--last", 14, "--profile", "--json").stdout)
    stages = answer["profile"]["stages"]
    assert (stages["track"]["items"], stages["fuse"]["items"]) == (15, 15)
    profiles = json.loads((tmp_path / "run.speedscope.json").read_text())["profiles"]
    assert "MainThread" in {profile["name"] for profile in profiles}


def test_without_rerun_a_map_is_looked_at_in_a_browser(run_folder, tmp_path):
    code = (
        "import sys; from importlib.abc import MetaPathFinder\n"
        "class Absent(MetaPathFinder):\n"
        "    def find_spec(self, name, *_):\n"
        "        if name.split('.')[0] == 'rerun': raise ModuleNotFoundError(name=name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        "from mapper.cli.main import app; app()"
    )
    arguments = ["view", run_folder, "--html", "--out", tmp_path / "map.html"]
    subprocess.run([sys.executable, "-c", code, *arguments], check=True)
    assert (tmp_path / "map.html").stat().st_size > 10_000


@pytest.mark.parametrize(("absent", "options"), [(True, " --html"), (False, "")])
def test_a_summary_ends_with_a_command_that_works(run_folder, monkeypatch, absent, options):
    monkeypatch.setattr("mapper.cli.summary.find_spec", {"rerun": None if absent else find_spec("json")}.get)
    last = short_text(open_run(run_folder), []).splitlines()[-1]
    assert last.endswith(f"mapper view {run_folder}{options}")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["build", "nowhere", "--out", "run"], "mapper: nowhere: no such file or folder"),
        (["build", "LOG", "--out", "RUN"], "pass --overwrite to replace it"),
        (["build", "LOG", "--out", "run", "--last", "4", "--quiet"], "mapper: only 5 frames were read"),
        (["build", "LOG", "--out", "a", "--last", "4", "--quiet"], "/a.partial"),
        (["build", "LOG", "--out", "run", "--config", "no.toml"], "mapper: no.toml: cannot be read"),
        (["fuse", "nowhere"], "mapper: nowhere: no such run folder"),
        (["fuse", "LOG"], "LOG: is a log, not a run; map it first: mapper build LOG"),
        (["report", "PLACE"], "PLACE: is no run itself, but holds "),
        (["fuse", "."], "mapper: .: is no run folder: it has no manifest.json"),
        (["build", "RUN", "--out", "run"], "a run that mapper wrote: its trajectory, its map and images"),
        (["fuse", "RUN", "--set", "graph.solve=none"], "mapper: graph: fuse keeps what was tracked"),
        (["fuse", "RUN", "--log", "gone"], "gone: the log of RUN is no longer there; give its new place"),
        (["export", "RUN", "--as", "jpeg"], "mapper: no exporter 'jpeg'; want one of octomap, native, ply"),
        (["export", "RUN", "--as", "ply", "--out", "a.obj"], "mapper: a.obj: ply files end with .ply"),
        (["eval", "RUN", "--map", "nowhere"], "mapper: nowhere: no such reference for a map"),
        (["eval", "RUN", "--tolerance", "2"], "mapper: --tolerance 2: has no meaning without --map"),
        (["eval", "RUN", "--lengths", "1;2"], "mapper: --lengths 1;2: want metres with commas"),
        (["eval", "RUN", "--lengths", "99"], "mapper: --lengths 99: the true path, where there are poses"),
        (["eval", "RUN", "--log", "nowhere"], "mapper: nowhere: --log is for bare trajectories"),
        (["eval", "RUN", "--times", "nowhere"], "mapper: nowhere: --times is for poses in KITTI text"),
        (["eval", "RUN", "--truth", "nowhere"], "mapper: nowhere: cannot be read"),
        (["convert", "LOG"], "mapper: --as: want one of tum, mbag, kitti, mcap, bag; an --out"),
        (["convert", "LOG", "--out", "folder"], "mapper: --as: want one of"),
        (["synth", "log", "--rooms", "5"], "mapper: rooms: want a multiple of 2"),
        (["demo", "--out", "LOG", "--set", "workers=x"], "mapper: workers: want a whole number"),
        (["config", "--set", "odometry.kind=zip"], "mapper: odometry: no kind 'zip'; want one of"),
    ],
)
def test_a_mistake_is_one_line(run_folder, desk_log, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    places = {"LOG": str(desk_log), "RUN": str(run_folder), "PLACE": str(run_folder.parent)}

    def told(text):
        return re.sub("LOG|RUN|PLACE", lambda found: places[found[0]], text)

    result = mapper(*map(told, arguments), status=1)

    assert len(result.stderr.splitlines()) == 1
    assert told(message) in result.stderr


def test_ctrl_c_ends_with_130_and_one_line_and_a_bug_keeps_its_traceback(desk_log, tmp_path, monkeypatch):
    def stumble(*_arguments, **_options):
        raise errors.pop()

    errors = [ZeroDivisionError(), KeyboardInterrupt()]
    monkeypatch.setattr("mapper.api.build.build_run", stumble)
    result = mapper("build", desk_log, "--out", tmp_path / "run", status=130)
    assert result.stderr == "mapper: interrupted\n"
    with pytest.raises(ZeroDivisionError):
        mapper("build", desk_log, "--out", tmp_path / "run")


def test_fuse_changes_the_map_of_a_run(run_folder, tmp_path):
    run = shutil.copytree(run_folder, tmp_path / "run")

    assert "voxels of 0.2 m" in mapper("fuse", run, "--set", "octree.resolution_m=0.2").stdout

    assert open_run(run).manifest.counts.leaves < open_run(run_folder).manifest.counts.leaves
    assert (run / "trajectory.tum").read_bytes() == (run_folder / "trajectory.tum").read_bytes()


def test_export_prints_where_its_file_is(run_folder, tmp_path):
    assert mapper("export", run_folder, "--as", "tum").stdout == f"{run_folder / 'trajectory.tum'}\n"

    out = tmp_path / "poses.txt"
    assert mapper("export", run_folder, "--as", "kitti", "--out", out).stdout == f"{out}\n"
    again = mapper("export", run_folder, "--as", "kitti", "--out", out, status=1)
    assert again.stderr == (
        f"mapper: {out}: exists already; choose another --out, or pass --overwrite to replace it\n"
    )
    assert mapper("export", run_folder, "--as", "kitti", "--out", out, "--overwrite", "--quiet").output == ""


def test_eval_states_the_alignment_and_agrees_with_the_library(run_folder, desk_log):
    estimate, truth = run_folder / "trajectory.tum", desk_log / "groundtruth.txt"

    of_run = json.loads(mapper("eval", run_folder, "--json").stdout)
    of_files = json.loads(mapper("eval", estimate, "--truth", truth, "--log", desk_log, "--json").stdout)

    values = {metric["name"]: metric["value"] for metric in of_files["metrics"]}
    frames_ns = np.array([record.stamp_ns for record in open_run(run_folder).records])
    found = assess(read_tum(estimate), read_tum(truth), frames_ns=frames_ns)
    assert {m.name: m.value for m in found.metrics}.items() <= values.items()
    told = {metric["name"]: metric["value"] for metric in of_run["metrics"]}
    assert {name: told[name] for name in values} == pytest.approx(values)
    assert {metric.name: metric.value for metric in evaluate(run_folder)}.items() <= told.items()
    assert told["loops wrongly accepted"] == 0
    assert "ATE RMSE, SE(3)-aligned" in mapper("eval", run_folder).stdout
    assert "ATE RMSE, Sim(3)-aligned" in mapper("eval", run_folder, "--align", "sim3").stdout
    assert "ATE RMSE, not aligned" in mapper("eval", run_folder, "--align", "none").stdout
    assert "ATE" not in mapper("eval", estimate).stdout


def test_eval_holds_the_map_against_the_world_of_a_synthetic_log(run_folder, desk_log, tmp_path):
    plots = tmp_path / "plots"
    printed = mapper("eval", run_folder, "--map", desk_log, "--sharpness", "--plot", plots, "--format", "csv")
    values = {row["name"]: float(row["value"]) for row in csv.DictReader(io.StringIO(printed.stdout))}
    assert values["occupied F-score, within 1 voxel"] > 0.9
    assert 0.0 < values["wall thickness median, radius 0.2 m"] < 0.1
    assert sorted(path.name for path in plots.iterdir()) == ["map.png", "trajectory.png"]

    of_itself = mapper(
        "eval", run_folder, "--map", run_folder, "--tolerance", 0, "--format", "markdown"
    ).stdout
    assert "| occupied F-score, within 0 voxels | 1 | ratio |" in of_itself
    lost = json.loads(mapper("eval", run_folder, "--map", desk_log, "--map-world", "map", "--json").stdout)
    scores = {row["name"]: row["value"] for row in lost["metrics"]}
    assert scores["occupied F-score, within 1 voxel"] < 0.7


def test_eval_judges_a_run_without_a_truth(run_folder, desk_log, tmp_path):
    bare, other = tmp_path / "bare", tmp_path / "other"
    shutil.copytree(desk_log, bare)
    (bare / "groundtruth.txt").unlink()
    mapper("build", bare, "--out", other, "--last", 17, "--set", "odometry.kind=pnp", "--quiet")
    told = json.loads(mapper("eval", other, "--json").stdout)["metrics"]
    values = {metric["name"]: metric["value"] for metric in told}
    assert "ATE RMSE, SE(3)-aligned" not in values
    assert 0.0 < values["disagreement of views RMS"] < 0.05
    shutil.rmtree(bare)
    assert "not measured" in mapper("eval", other).stdout

    compared = mapper("eval", run_folder, "--against", other).stdout
    assert int(re.search(r"views compared in both runs +(\d+)", compared)[1]) > 50
    assert "whose files are not those of" in compared
    assert "whose files" not in mapper("eval", run_folder, "--against", run_folder).stdout
    mapper("eval", run_folder, "--gate", "ATE RMSE=1", "--quiet")
    assert "more than 0.0001" in mapper("eval", run_folder, "--gate", "ATE RMSE=0.0001", status=1).stderr


def test_eval_reads_kitti_text_with_and_without_times(run_folder, tmp_path):
    poses, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    mapper("export", run_folder, "--as", "kitti", "--out", poses)
    times.write_text("\n".join((run_folder / "trajectory.tum").read_text().split("\n")[1:]))
    by_line = json.loads(mapper("eval", poses, "--truth", poses, "--json").stdout)
    by_time = json.loads(
        mapper("eval", poses, "--truth", run_folder / "truth.tum", "--times", times, "--json").stdout
    )
    of_run = json.loads(mapper("eval", run_folder, "--json").stdout)
    assert by_line["metrics"][1]["value"] < 1e-9
    assert by_time["metrics"][1] == pytest.approx(of_run["metrics"][1])


def test_a_converted_log_gives_the_same_trajectory(run_folder, desk_log, tmp_path):
    mapper("convert", desk_log, "--as", "mbag", "--out", tmp_path / "log")
    assert mapper("build", tmp_path / "log", "--out", tmp_path / "run", "--quiet").output == ""

    ours, theirs = open_run(tmp_path / "run").trajectory, open_run(run_folder).trajectory
    assert ours.stamps_ns.tolist() == theirs.stamps_ns.tolist()
    assert abs(ours.T_world_body - theirs.T_world_body).max() < 1e-12


@pytest.mark.parametrize("ending", ["mcap", "bag"])
def test_the_ending_of_a_converted_log_says_its_format(desk_log, tmp_path, ending):
    path = tmp_path / f"desk.{ending}"
    result = mapper("convert", desk_log, "--out", path, "--first", 29)
    assert result.stdout == f"{path}: 2 frames as {ending}, 0 skipped\n"
    assert len(open_source(path)) == 2


def test_config_prints_what_build_would_use(tmp_path):
    path, overrides = tmp_path / "isvd.toml", ("--set", "odometry.kind=isvd", "--set", "workers=1")
    path.write_text(mapper("config", *overrides).stdout)

    again = mapper("config", "--config", path)
    assert again.stdout == path.read_text()
    assert tomllib.loads(again.stdout)["odometry"]["previous_frames"] == 4
    of_json = mapper("config", *overrides, "--json").stdout
    assert json.loads(mapper("config", "--config", path, "--json").stdout) == json.loads(of_json)


def test_a_package_that_cannot_be_written_gets_another_place_for_compiled_code(tmp_path, monkeypatch):
    from mapper.cli import environment

    monkeypatch.setattr(environment.os, "access", lambda _path, _mode: False)
    monkeypatch.setattr(environment.os, "environ", {"XDG_CACHE_HOME": str(tmp_path)})
    environment.prepare_environment()

    assert environment.os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "mapper" / "numba")
    assert environment.os.environ["OMP_NUM_THREADS"] == "1"


def test_many_notes_become_few_lines(capsys):
    lines = Lines()
    for i in range(100):
        lines.note(f"skipped: {i}")
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "mapper: skipped: 0"
    assert len(said) == 6


def test_the_time_left_is_told_by_the_later_half_of_what_was_done(monkeypatch, capsys):
    now_s = [100.0]
    monkeypatch.setattr("mapper.cli.console.time.monotonic", lambda: now_s[0])
    with Lines().stage("track") as report:
        for at_s, done in [(130.0, 1), (145.0, 2), *((145.0 + s, 2 + 10 * s) for s in range(1, 61))]:
            now_s[0] = at_s
            report(done, 802)
    said = capsys.readouterr().err.splitlines()
    assert said[:2] == ["track: 1/802", "track: 2/802"]  # it waits for the compiler
    assert said[2] == "track: 112/802, 4.3/s, 162 s left"
    assert said[-2] == "track: 552/802, 10/s, 25 s left"


def test_bars_end_full(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    with Bars().stage("fuse") as report:
        report(3, 3)
    assert "3/3" in capsys.readouterr().err


def test_help_version_and_short_options_are_as_elsewhere(run_folder, tmp_path):
    assert mapper("version").output == mapper("--version").output
    assert mapper("--version").stdout.startswith("mapper ")
    assert mapper("help", "sensor", "depth").output == mapper("sensor", "depth", "--help").output
    out = tmp_path / "map.bt"
    assert mapper("export", run_folder, "--as", "octomap", "-o", out, "-q").output == ""
    assert out.exists()
