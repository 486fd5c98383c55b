"""A build that was stopped is resumed, and ends in the bytes of one that was not."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from mapper.cli.summary import summary_text
from mapper.core.errors import RunError, TrackingError
from mapper.odometry.keyframes.odometry import KeyframeOdometry
from mapper.pipeline.checkpoint_identity import write_identity
from mapper.places.vocabulary import SHIPPED
from mapper.run.folder import open_run
from mapper.run.manifest import read_manifest
from mapper.runtime.atomic import locked, partial_of
from mapper.runtime.journal import StateFile, opened_state
from mapper.runtime.state_file import load
from tests.support.command_line import mapper
from tests.support.desk import REPEATABLE
from tests.support.files import files_of
from tests.support.paths import ROOT
from tests.support.progress import Observer, Stopped
from tests.support.stopped_builds import (
    CHECKPOINTS,
    StopAt,
    assert_same,
    newest,
    resumed,
    start,
    stopped,
)


def test_tracking_goes_on_at_the_frame_where_it_was_stopped(short_log, short_run, tmp_path):
    out = tmp_path / "run"
    for frames in (6, 5):
        stopped(short_log, out, observer=StopAt(frames))
    assert read_manifest(partial_of(out) / "manifest.json").status == "interrupted"
    with pytest.raises(RunError, match="the same mapper build resumes it"):
        open_run(out)

    run = start(short_log, out)

    assert_same(run, short_run)
    assert resumed(run) == [("track", 5), ("track", 9)]
    (line,) = [line for line in summary_text(run, []).splitlines() if line.startswith("resumed ")]
    assert line.endswith(" track at frame 5; track at frame 9")


def test_a_scan_odometry_of_a_compiled_library_goes_on_to_the_same_bytes(street, tmp_path):
    chosen = "odometry.kind=kiss-icp"
    wanted = start(street, tmp_path / "wanted", chosen, checkpoint_s=None)
    stopped(street, tmp_path / "run", chosen, observer=StopAt(4))
    stopped(street, tmp_path / "run", chosen, observer=StopAt(4))
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
def test_every_image_odometry_goes_on_to_the_same_bytes(short_log, tmp_path, settings):
    wanted = start(short_log, tmp_path / "wanted", *settings, checkpoint_s=None)
    stopped(short_log, tmp_path / "run", *settings, observer=StopAt(9))
    run = start(short_log, tmp_path / "run", *settings)
    assert_same(run, wanted)
    assert resumed(run)[0][0] == "track"


def test_fusing_goes_on_without_casting_again(short_log, short_run, street, street_run, tmp_path):
    for log, wanted, frame in ((short_log, short_run, 6), (street, street_run, 8)):
        out = tmp_path / log.name
        stopped(log, out, progress=Observer("fuse", frame))
        progress = Observer("fuse", frame + 4)
        stopped(log, out, progress=progress)
        run = start(log, out)
        assert_same(run, wanted)
        assert resumed(run) == [("fuse", frame - 1), ("fuse", frame + 3)]
        assert f"an earlier process was stopped; resuming with fuse at frame {frame - 1}" in progress.notes


def test_a_solve_is_not_made_twice(short_log, short_run, tmp_path, monkeypatch):
    out = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr("mapper.pipeline.build.solve", lambda *_: (_ for _ in ()).throw(Stopped()))
        stopped(short_log, out)
    with monkeypatch.context() as patched:
        patched.setattr("mapper.pipeline.build.track_log", None)
        writing = "mapper.pipeline.write_maps.write_maps"
        patched.setattr(writing, lambda *_, **__: (_ for _ in ()).throw(Stopped()))
        stopped(short_log, out)
        patched.setattr("mapper.pipeline.build.solve", None)
        stopped(short_log, out)
    run = start(short_log, out)
    assert_same(run, short_run)
    assert resumed(run) == [("solve", 0), ("fuse", 0)]


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.support.stopped_builds import StopAt, start
log, out, frames = sys.argv[1:]
stop = StopAt(int(frames), lambda: os.kill(os.getpid(), signal.SIGKILL))
start(Path(log), Path(out), observer=stop)
"""


def test_a_killed_process_leaves_what_another_goes_on_from(short_log, short_run, tmp_path):
    command = [sys.executable, "-c", KILLED, short_log, tmp_path / "run", "11"]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == -signal.SIGKILL
    assert read_manifest(tmp_path / "run.partial/manifest.json").status == "building"
    run = start(short_log, tmp_path / "run")
    assert_same(run, short_run)
    assert resumed(run)


def test_other_settings_are_refused_until_it_is_begun_anew(short_log, unfinished):
    kept = files_of(partial_of(unfinished) / CHECKPOINTS)
    for arguments in (("--set", "octree.resolution_m=0.1"), ("--first", 2)):
        told = mapper(
            "build", short_log, "--out", unfinished, "--set", REPEATABLE, *arguments, status=1
        ).stderr
        assert f"mapper: {partial_of(unfinished)}: an unfinished build with " in told
        assert "finish it with the arguments it had, or begin anew with --fresh" in told
    assert "source.first_frame=0, not 2" in told
    assert files_of(partial_of(unfinished) / CHECKPOINTS) == kept

    told = mapper("build", short_log, "--out", unfinished, "--set", "octree.resolution_m=0.1", "--fresh")
    assert "resumed" not in told.stdout
    assert not (unfinished / CHECKPOINTS).exists()


def test_the_command_goes_on_and_says_so(short_log, short_run, unfinished):
    told = mapper("build", short_log, "--out", unfinished, "--set", REPEATABLE)
    assert "an earlier process was stopped; resuming with track at frame " in told.stderr
    assert "resumed" in told.stdout
    assert_same(open_run(unfinished), short_run)


def test_another_log_or_version_is_refused(short_log, street, unfinished):
    with pytest.raises(RunError, match=rf"an unfinished build with another log \({short_log}, or as it was"):
        start(street, unfinished)
    path = partial_of(unfinished) / CHECKPOINTS / "identity.json"
    identity = json.loads(path.read_text())
    del identity["digest"]
    identity["versions"]["numpy"] = "1.0"
    write_identity(path, identity)
    with pytest.raises(RunError, match=r"an unfinished build with numpy 1\.0, not 2"):
        start(short_log, unfinished)


def test_a_full_disk_ends_the_checkpoints_and_not_the_build(short_log, short_run, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(StateFile, "write", full)
    progress = Observer()
    run = start(short_log, tmp_path / "run", progress=progress)
    (note,) = [note for note in progress.notes if note.startswith("checkpoints")]
    assert note.startswith("checkpoints cannot be written (No space left on device); the build goes on")
    assert_same(run, short_run)


def test_a_state_that_cannot_be_written_ends_the_checkpoints_and_not_the_build(
    short_log, short_run, tmp_path, monkeypatch
):
    monkeypatch.setattr(KeyframeOdometry, "__getstate__", lambda _: {"its": lambda: None}, raising=False)
    progress = Observer()
    run = start(short_log, tmp_path / "run", progress=progress)
    (note,) = [note for note in progress.notes if note.startswith("checkpoints")]
    assert "a state that cannot be written" in note
    assert_same(run, short_run)


def test_files_that_settings_name_have_to_be_the_same(short_log, tmp_path):
    words = shutil.copyfile(SHIPPED, tmp_path / "own.words")
    chosen = f"odometry.vocabulary={words}"
    stopped(short_log, tmp_path / "run", chosen, observer=StopAt(2))
    words.write_bytes(words.read_bytes() + b" ")
    with pytest.raises(RunError, match=r"an unfinished build with another file of odometry\.vocabulary"):
        start(short_log, tmp_path / "run", chosen)


def test_a_build_that_is_under_way_is_not_gone_on_with(short_log, unfinished):
    before = files_of(partial_of(unfinished) / CHECKPOINTS)
    with locked(partial_of(unfinished)), pytest.raises(RunError, match="another process is filling it"):
        start(short_log, unfinished)
    assert files_of(partial_of(unfinished) / CHECKPOINTS) == before


def test_a_build_that_failed_can_be_begun_with_other_settings(short_log, tmp_path):
    with pytest.raises(TrackingError):
        start(short_log, tmp_path / "run", "min_tracked_frames=100")
    assert not (partial_of(tmp_path / "run") / CHECKPOINTS).exists()
    stopped(short_log, tmp_path / "run", observer=StopAt(2))


def test_times_of_all_processes_add_up(short_log, unfinished):
    with opened_state(newest(partial_of(unfinished) / CHECKPOINTS)) as file:
        before_s = load(file)["seconds"]["track"]
    began = time.perf_counter()
    timing = start(short_log, unfinished).manifest.timing
    since_s = time.perf_counter() - began
    assert before_s < timing.stage_s["track"] < timing.total_s < before_s + since_s
