"""A build that was stopped goes on where it was, and ends in the bytes of one that was not."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

from mapper.cli.summary import summary_text
from mapper.config.loading import load_config
from mapper.core.errors import RunError, TrackingError
from mapper.odometry.local_map.odometry import KeyframeOdometry
from mapper.pipeline.build import build
from mapper.places.vocabulary import SHIPPED
from mapper.run.checks import check_run
from mapper.run.folder import open_run
from mapper.run.manifest import read_manifest
from mapper.run.observers import NullObserver
from mapper.runtime.atomic import locked, partial_of
from mapper.runtime.journal import StateFile, opened_state
from mapper.runtime.progress import Silent
from mapper.runtime.state_pickle import load
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source
from tests.support.command_line import mapper
from tests.support.desk import REPEATABLE
from tests.support.files import files_of
from tests.support.paths import ROOT

CHECKPOINTS = ".checkpoints.part"
MEASURED = {"manifest.json", "frame_ms.csv"}


class Stopped(KeyboardInterrupt):
    """Ctrl-C at a certain frame."""


class StopAt(NullObserver):
    """Stops a build when it has tracked so many frames."""

    def __init__(self, frames, stop=None):
        self.left, self.stop = frames, stop

    def on_frame(self, _step):
        self.left -= 1
        if not self.left:
            if self.stop is not None:
                self.stop()
            raise Stopped


class Stage(Silent):
    """Keeps notes, and stops a build at a frame of a stage."""

    def __init__(self, name="", frame=0):
        self.notes, self.name, self.frame = [], name, frame

    @contextmanager
    def stage(self, name):
        def report(done, _total):
            if name == self.name and done == self.frame:
                raise Stopped

        yield report

    def note(self, message):
        self.notes.append(message)


def start(log, out, *overrides, checkpoint_s=0.0, **arguments):
    source = open_source(log)
    config = load_config(None, [REPEATABLE, *overrides], sensor=source.sensor)
    return build(source, config, out, checkpoint_s=checkpoint_s, **arguments)


def stopped(log, out, *overrides, **arguments):
    """Begin or go on with a build, and stop it."""
    with pytest.raises(Stopped):
        start(log, out, *overrides, **arguments)
    return partial_of(out) / CHECKPOINTS


def assert_same(run, wanted):
    ours, theirs = files_of(run.path), files_of(wanted.path)
    assert ours.keys() == theirs.keys()
    for name in ours.keys() - MEASURED:
        assert ours[name] == theirs[name], name
    measured = {"timing": wanted.manifest.timing, "files": wanted.manifest.files}
    assert run.manifest.model_copy(update=measured) == wanted.manifest
    assert not any(finding.verdict == "failed" for finding in check_run(run.path))


def resumed(run):
    return [(resumption.step, resumption.frame) for resumption in run.manifest.timing.resumed]


@pytest.fixture(scope="module")
def half(desk_log, tmp_path_factory):
    """A build of the desk log that was stopped at frame 20; tests work on copies."""
    out = tmp_path_factory.mktemp("half") / "run"
    stopped(desk_log, out, observer=StopAt(20))
    return out


@pytest.fixture
def unfinished(half, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(partial_of(half), partial_of(out))
    return out


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs") / "street"
    sensor = LidarSensorConfig(rings=24, azimuth_steps=360)
    write_lidar_log(folder, STREET.model_copy(update={"duration_s": 2.0, "sensor": sensor}))
    return folder


@pytest.fixture(scope="module")
def street_run(street, tmp_path_factory):
    return start(street, tmp_path_factory.mktemp("runs") / "street", checkpoint_s=None)


def test_tracking_goes_on_at_the_frame_where_it_was_stopped(desk_log, desk_run, tmp_path):
    out = tmp_path / "run"
    for frames in (9, 8):
        stopped(desk_log, out, observer=StopAt(frames))
    assert read_manifest(partial_of(out) / "manifest.json").status == "interrupted"
    with pytest.raises(RunError, match="the same mapper build goes on where it was"):
        open_run(out)

    run = start(desk_log, out)

    assert_same(run, desk_run)
    assert resumed(run) == [("track", 8), ("track", 15)]
    (line,) = [line for line in summary_text(run, []).splitlines() if line.startswith("resumed ")]
    assert line.endswith(" track at frame 8; track at frame 15")


@pytest.mark.parametrize("kind", ["gicp", "kiss-icp", "icp"])
def test_every_scan_odometry_goes_on_to_the_same_bytes(street, tmp_path, kind):
    chosen = f"odometry.kind={kind}"
    wanted = start(street, tmp_path / "wanted", chosen, checkpoint_s=None)
    stopped(street, tmp_path / "run", chosen, observer=StopAt(7))
    stopped(street, tmp_path / "run", chosen, observer=StopAt(7))
    run = start(street, tmp_path / "run", chosen)
    assert_same(run, wanted)
    assert len(resumed(run)) == 2


@pytest.mark.parametrize(
    "settings",
    [
        ("odometry.kind=pnp", "graph.solve=proportional"),
        ("odometry.kind=isvd", "loops.kind=thesis"),
        ("odometry.kind=given", "loops.kind=none"),
    ],
    ids=lambda settings: settings[0].split("=")[1],
)
def test_every_image_odometry_goes_on_to_the_same_bytes(desk_log, tmp_path, settings):
    few = (*settings, "source.last_frame=16")
    wanted = start(desk_log, tmp_path / "wanted", *few, checkpoint_s=None)
    stopped(desk_log, tmp_path / "run", *few, observer=StopAt(9))
    run = start(desk_log, tmp_path / "run", *few)
    assert_same(run, wanted)
    assert resumed(run)[0][0] == "track"


def test_fusing_goes_on_without_casting_again(desk_log, desk_run, street, street_run, tmp_path):
    for log, wanted, frame in ((desk_log, desk_run, 12), (street, street_run, 15)):
        out = tmp_path / log.name
        stopped(log, out, progress=Stage("fuse", frame))
        progress = Stage("fuse", frame + 4)
        stopped(log, out, progress=progress)
        run = start(log, out)
        assert_same(run, wanted)
        assert resumed(run) == [("fuse", frame - 1), ("fuse", frame + 3)]
        assert f"an earlier process was stopped; going on with fuse at frame {frame - 1}" in progress.notes


def test_a_solve_is_not_made_twice(desk_log, desk_run, tmp_path, monkeypatch):
    out = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr("mapper.pipeline.build.solve", lambda *_: (_ for _ in ()).throw(Stopped()))
        stopped(desk_log, out)
    with monkeypatch.context() as patched:
        patched.setattr("mapper.pipeline.build.track_log", None)
        patched.setattr("mapper.pipeline.build.fuse_into", lambda *_, **__: (_ for _ in ()).throw(Stopped()))
        stopped(desk_log, out)
        patched.setattr("mapper.pipeline.build.solve", None)
        stopped(desk_log, out)
    run = start(desk_log, out)
    assert_same(run, desk_run)
    assert resumed(run) == [("solve", 0), ("fuse", 0)]


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.pipeline.test_resume import StopAt, start
log, out, frames = sys.argv[1:]
stop = StopAt(int(frames), lambda: os.kill(os.getpid(), signal.SIGKILL))
start(Path(log), Path(out), observer=stop)
"""


def test_a_killed_process_leaves_what_another_goes_on_from(desk_log, desk_run, tmp_path):
    command = [sys.executable, "-c", KILLED, desk_log, tmp_path / "run", "20"]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == -signal.SIGKILL
    assert read_manifest(tmp_path / "run.partial/manifest.json").status == "building"
    run = start(desk_log, tmp_path / "run")
    assert_same(run, desk_run)
    assert resumed(run)


def damage(path, how):
    data = bytearray(path.read_bytes())
    if how == "torn":
        del data[len(data) // 2 :]
    else:
        data[len(data) // 2] ^= 16
    path.write_bytes(data)


def newest(folder):
    return next(iter(StateFile(folder, "odometry").versions()[0].values()))


@pytest.mark.parametrize("how", ["torn", "flipped"])
def test_a_damaged_checkpoint_leaves_the_one_before_it(desk_log, desk_run, unfinished, how):
    folder, progress = partial_of(unfinished) / CHECKPOINTS, Stage()
    damage(newest(folder), how)
    run = start(desk_log, unfinished, progress=progress)
    assert "the newest checkpoint is damaged or torn; the one before it is used" in progress.notes
    assert resumed(run)
    assert_same(run, desk_run)


@pytest.mark.parametrize("what", ["both checkpoints", "journal"])
def test_damaged_checkpoints_begin_anew_with_a_word(desk_log, desk_run, unfinished, what):
    folder, progress = partial_of(unfinished) / CHECKPOINTS, Stage()
    if what == "journal":
        data = bytearray((folder / "tracking.journal").read_bytes())
        data[100] ^= 1
        (folder / "tracking.journal").write_bytes(data)
    else:
        for path in folder.glob("odometry.*"):
            damage(path, "flipped")
    run = start(desk_log, unfinished, progress=progress)
    assert "the checkpoints of an earlier process are damaged; tracking begins anew" in progress.notes
    assert resumed(run) == []
    assert_same(run, desk_run)


def test_a_torn_tail_of_the_journal_costs_nothing(desk_log, desk_run, unfinished):
    with (partial_of(unfinished) / CHECKPOINTS / "tracking.journal").open("ab") as file:
        file.write(b"\x20\0\0\0\0\0\0\0half of a record")
    run = start(desk_log, unfinished)
    assert resumed(run)
    assert_same(run, desk_run)


def test_a_torn_file_of_updates_is_not_used(desk_log, desk_run, tmp_path):
    out = tmp_path / "run"
    stopped(desk_log, out, progress=Stage("fuse", 20))
    damage(partial_of(out) / "scan_updates.bin", "flipped")
    run = start(desk_log, out)
    assert_same(run, desk_run)
    assert [step for step, _ in resumed(run)] == ["fuse"]


def test_other_settings_are_refused_until_it_is_begun_anew(desk_log, unfinished):
    kept = files_of(partial_of(unfinished) / CHECKPOINTS)
    for arguments in (("--set", "octree.resolution_m=0.1"), ("--first", 2)):
        told = mapper(
            "build", desk_log, "--out", unfinished, "--set", REPEATABLE, *arguments, status=1
        ).stderr
        assert f"mapper: {partial_of(unfinished)}: an unfinished build with " in told
        assert "finish it with the arguments it had, or begin anew with --fresh" in told
    assert "source.first_frame=0, not 2" in told
    assert files_of(partial_of(unfinished) / CHECKPOINTS) == kept

    told = mapper("build", desk_log, "--out", unfinished, "--set", "octree.resolution_m=0.1", "--fresh")
    assert "resumed" not in told.stdout
    assert not (unfinished / CHECKPOINTS).exists()


def test_the_command_goes_on_and_says_so(desk_log, desk_run, unfinished):
    told = mapper("build", desk_log, "--out", unfinished, "--set", REPEATABLE)
    assert "an earlier process was stopped; going on with track at frame " in told.stderr
    assert "resumed" in told.stdout
    assert_same(open_run(unfinished), desk_run)


def test_another_log_or_version_is_refused(desk_log, street, unfinished):
    with pytest.raises(RunError, match=rf"an unfinished build with another log \({desk_log}, or as it was"):
        start(street, unfinished)
    path = partial_of(unfinished) / CHECKPOINTS / "identity.json"
    identity = json.loads(path.read_text())
    identity["versions"]["numpy"] = "1.0"
    path.write_text(json.dumps(identity))
    with pytest.raises(RunError, match=r"an unfinished build with numpy 1\.0, not 2"):
        start(desk_log, unfinished)


@pytest.mark.parametrize("left", ["", "{", "[]", '{"config": 3}'])
def test_checkpoints_without_an_identity_are_not_used(desk_log, unfinished, left):
    (partial_of(unfinished) / CHECKPOINTS / "identity.json").write_text(left)
    with pytest.raises(Stopped):
        start(desk_log, unfinished, observer=StopAt(1))


def test_a_full_disk_ends_the_checkpoints_and_not_the_build(desk_log, desk_run, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(StateFile, "write", full)
    progress = Stage()
    run = start(desk_log, tmp_path / "run", progress=progress)
    (note,) = [note for note in progress.notes if note.startswith("checkpoints")]
    assert note.startswith("checkpoints cannot be written (No space left on device); the build goes on")
    assert_same(run, desk_run)


def test_a_state_that_cannot_be_written_ends_the_checkpoints_and_not_the_build(
    desk_log, desk_run, tmp_path, monkeypatch
):
    monkeypatch.setattr(KeyframeOdometry, "__getstate__", lambda _: {"its": lambda: None}, raising=False)
    progress = Stage()
    run = start(desk_log, tmp_path / "run", progress=progress)
    (note,) = [note for note in progress.notes if note.startswith("checkpoints")]
    assert "a state that cannot be written" in note
    assert_same(run, desk_run)


def test_files_that_settings_name_have_to_be_the_same(desk_log, tmp_path):
    words = shutil.copyfile(SHIPPED, tmp_path / "own.words")
    chosen = f"odometry.vocabulary={words}"
    stopped(desk_log, tmp_path / "run", chosen, observer=StopAt(2))
    words.write_bytes(words.read_bytes() + b" ")
    with pytest.raises(RunError, match=r"an unfinished build with another file of odometry\.vocabulary"):
        start(desk_log, tmp_path / "run", chosen)


def test_a_build_that_is_under_way_is_not_gone_on_with(desk_log, unfinished):
    before = files_of(partial_of(unfinished) / CHECKPOINTS)
    with locked(partial_of(unfinished)), pytest.raises(RunError, match="another process is filling it"):
        start(desk_log, unfinished)
    assert files_of(partial_of(unfinished) / CHECKPOINTS) == before


def test_a_build_that_failed_can_be_begun_with_other_settings(desk_log, tmp_path):
    with pytest.raises(TrackingError):
        start(desk_log, tmp_path / "run", "min_tracked_frames=100")
    assert not (partial_of(tmp_path / "run") / CHECKPOINTS).exists()
    stopped(desk_log, tmp_path / "run", observer=StopAt(2))


def test_times_of_all_processes_add_up(desk_log, unfinished):
    with opened_state(newest(partial_of(unfinished) / CHECKPOINTS)) as file:
        before_s = load(file)["seconds"]["track"]
    began = time.perf_counter()
    timing = start(desk_log, unfinished).manifest.timing
    since_s = time.perf_counter() - began
    assert before_s < timing.stage_s["track"] < timing.total_s < before_s + since_s
