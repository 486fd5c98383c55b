"""Checkpoints that were torn, damaged or spoilt by a power cut cost work, and no bytes of the result."""

import shutil

import numpy as np
import pytest

from mapper.runtime.archive import Archive
from mapper.runtime.atomic import partial_of
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


def damage(path, how):
    data = bytearray(path.read_bytes())
    if how == "torn":
        del data[len(data) // 2 :]
    else:
        data[len(data) // 2] ^= 16
    path.write_bytes(data)


def test_a_damaged_checkpoint_leaves_the_one_before_it(short_log, short_run, unfinished):
    folder, progress = partial_of(unfinished) / CHECKPOINTS, Observer()
    damage(newest(folder), "torn")
    run = start(short_log, unfinished, progress=progress)
    assert "the newest checkpoint is damaged or torn; the one before it is used" in progress.notes
    assert resumed(run)
    assert_same(run, short_run)


@pytest.mark.parametrize("what", ["both checkpoints", "journal"])
def test_damaged_checkpoints_begin_anew_with_a_word(short_log, short_run, unfinished, what):
    folder, progress = partial_of(unfinished) / CHECKPOINTS, Observer()
    if what == "journal":
        data = bytearray((folder / "tracking.journal").read_bytes())
        data[100] ^= 1
        (folder / "tracking.journal").write_bytes(data)
    else:
        for path in folder.glob("odometry.*"):
            damage(path, "flipped")
    run = start(short_log, unfinished, progress=progress)
    assert "the checkpoints of an earlier process are damaged; tracking begins anew" in progress.notes
    assert resumed(run) == []
    assert_same(run, short_run)


def test_a_torn_tail_of_the_journal_costs_nothing(short_log, short_run, unfinished):
    with (partial_of(unfinished) / CHECKPOINTS / "tracking.journal").open("ab") as file:
        file.write(b"\x20\0\0\0\0\0\0\0half of a record")
    run = start(short_log, unfinished)
    assert resumed(run)
    assert_same(run, short_run)


def test_a_torn_file_of_updates_is_not_used(short_log, short_run, tmp_path):
    out = tmp_path / "run"
    stopped(short_log, out, progress=Observer("fuse", 11))
    damage(partial_of(out) / "scan_updates.bin", "flipped")
    run = start(short_log, out)
    assert_same(run, short_run)
    assert [step for step, _ in resumed(run)] == ["fuse"]


@pytest.fixture(scope="module")
def half_fused(short_log, tmp_path_factory):
    """A build of the short log that was stopped while its frames were fused; tests work on copies."""
    out = tmp_path_factory.mktemp("half_fused") / "run"
    stopped(short_log, out, progress=Observer("fuse", 11))
    return out


@pytest.mark.parametrize("stage", ["half", "half_fused"])
@pytest.mark.parametrize("seed", range(2))
def test_a_power_cut_that_spoils_any_file_costs_work_and_no_bytes(
    request, short_log, short_run, tmp_path, stage, seed
):
    out, rng = tmp_path / "run", np.random.default_rng(seed)
    shutil.copytree(partial_of(request.getfixturevalue(stage)), partial_of(out))
    for path in sorted({*(partial_of(out) / CHECKPOINTS).iterdir(), partial_of(out) / "scan_updates.bin"}):
        if not path.exists():
            continue
        data = bytearray(path.read_bytes())
        place, what = int(rng.integers(len(data))), rng.choice(["torn", "zeros", "flipped", "sound"])
        if what == "torn":
            del data[place:]
        elif what == "zeros":  # where the length was on the disk, and the content was not
            data[place:] = bytes(len(data) - place)
        elif what == "flipped":
            data[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
    assert_same(start(short_log, out), short_run)


def test_what_lies_on_the_disk_alone_is_read_again_to_the_same_bytes(
    short_log, short_run, street, street_run, tmp_path, monkeypatch
):
    read = []

    class Forgetful(Archive):
        def __init__(self, journal):
            super().__init__(journal, recent_bytes=0)

        def read(self, reference):
            read.append(reference.place)
            return super().read(reference)

    monkeypatch.setattr("mapper.pipeline.checkpoints.Archive", Forgetful)
    monkeypatch.setattr("mapper.odometry.keyframes.keyframe._READY", 1)
    for log, wanted, frame in ((short_log, short_run, 11), (street, street_run, 8)):
        read.clear()
        stopped(log, tmp_path / log.name, observer=StopAt(frame))
        assert_same(start(log, tmp_path / log.name), wanted)
        assert read


@pytest.mark.parametrize("left", ["", "{", "[]", "[3]", '{"config": 3}', None])
def test_checkpoints_without_a_sound_identity_are_not_used(short_log, unfinished, left):
    path = partial_of(unfinished) / CHECKPOINTS / "identity.json"
    path.write_text(path.read_text().replace("0", "1", 1) if left is None else left)
    with pytest.raises(Stopped):
        start(short_log, unfinished, observer=StopAt(1))
