import errno
import json
import subprocess
import sys

import numpy as np
import pytest

from mapper.core.errors import RunError, SourceError, WriteError
from mapper.runtime import atomic
from mapper.runtime.atomic import (
    FolderKind,
    atomic_file,
    atomic_folder,
    flush_to_disk,
    new_folder,
    partial_of,
    write_bytes,
    write_text,
)
from tests.support.full_disk import largest_file

MAP = FolderKind("a map", manifest_keys=frozenset({"voxels"}), files=frozenset({"map.bt", "view_*.png"}))


def test_a_file_appears_whole_with_its_folders(tmp_path):
    path = tmp_path / "a/b/c.txt"
    write_text(path, "Poznań\n")
    assert path.read_bytes() == "Poznań\n".encode()
    write_bytes(path, b"\x00\x01")
    assert path.read_bytes() == b"\x00\x01"
    assert [p.name for p in path.parent.iterdir()] == ["c.txt"]


def test_the_old_file_stays_until_the_new_one_is_whole(tmp_path):
    def write_half(part):
        part.write_text("ha")
        raise KeyboardInterrupt

    path, names = tmp_path / "map.png", set()
    path.write_text("old")
    for new in ("a", "b"):
        old = path.read_text()
        with pytest.raises(KeyboardInterrupt), atomic_file(path) as part:
            write_half(part)
        assert list(tmp_path.iterdir()) == [path]
        with atomic_file(path) as part:
            names.add(part.name)
            assert (part.suffix, part.stat().st_size) == (".png", 0), (
                "writers choose the format by the ending"
            )
            part.write_text(new)
            assert path.read_text() == old
        assert path.read_text() == new
    assert len(names) == 2


def test_a_full_disk_is_told_with_the_final_name(tmp_path):
    path = tmp_path / "map.bt"
    path.write_text("old")
    values = np.zeros(100_000)

    def write_by_numpy():
        with atomic_file(path) as part, part.open("wb") as file:
            values.tofile(file)

    writers = (
        write_by_numpy,
        lambda: write_bytes(path, values.tobytes()),
        lambda: write_text(path, "x" * 100_000),
    )
    with largest_file(10_000):
        for write in writers:
            with pytest.raises(WriteError, match=rf"^{path}: cannot be written: "):
                write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_of_another_file_keeps_its_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"log/1\.png"), atomic_file(tmp_path / "run.mcap"):
        (tmp_path / "log/1.png").read_bytes()
    with pytest.raises(BrokenPipeError), atomic_file(tmp_path / "run.mcap"):
        raise BrokenPipeError(32, "Broken pipe")


def test_a_new_folder_on_a_full_disk_is_gone(tmp_path):
    def make_log():
        with new_folder(tmp_path / "log") as folder:
            (folder / "times.txt").write_text("0\n" * 1000)

    with largest_file(1000), pytest.raises(WriteError, match=rf"^{tmp_path / 'log'}: "):
        make_log()
    assert not list(tmp_path.iterdir())
    (tmp_path / "log").mkdir()
    (tmp_path / "log/mine").touch()
    with pytest.raises(SourceError, match="exists already"), new_folder(tmp_path / "log"):
        pytest.fail("the body must not run")


KILLED = """
import os, sys
from pathlib import Path
from mapper.runtime.atomic import FolderKind, atomic_folder, new_folder
out = Path(sys.argv[2])
kind = FolderKind("a map", manifest_keys=frozenset({"voxels"}), files=frozenset({"map.bt"}))
with atomic_folder(out, kind) if sys.argv[1] == "atomic" else new_folder(out) as folder:
    (folder / "cloud.ply").write_text("half")
    os._exit(9)
"""


@pytest.mark.parametrize("way", ["atomic", "new"])
def test_what_a_killed_process_left_is_replaced(tmp_path, way):
    out = tmp_path / "out"
    assert subprocess.run([sys.executable, "-c", KILLED, way, out], check=False).returncode == 9
    assert names_in(tmp_path) == ["out.partial"]
    with atomic_folder(out, MAP) if way == "atomic" else new_folder(out) as folder:
        (folder / "map.bt").write_text("whole")
    assert names_in(tmp_path) == ["out"]
    assert names_in(out) == ["map.bt"]


def test_a_folder_of_others_where_a_log_is_filled_is_left_alone(tmp_path):
    (tmp_path / "log.partial").mkdir()
    (tmp_path / "log.partial/mine").touch()
    with pytest.raises(SourceError, match="in the way"), new_folder(tmp_path / "log"):
        pytest.fail("the body must not run")
    assert names_in(tmp_path / "log.partial") == ["mine"]


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def make_map(out, text, **options):
    with atomic_folder(out, MAP, **options) as folder:
        (folder / "map.bt").write_text(text)
        (folder / "manifest.json").write_text('{"voxels": 1}')


@pytest.mark.parametrize(
    "manifest",
    [{"name": "an app", "icons": []}, {"status": "complete", "input": {}}, [1, 2], "voxels"],
    ids=["web application", "another kind", "list", "text"],
)
def test_a_foreign_manifest_does_not_make_a_folder_ours(tmp_path, manifest):
    (tmp_path / "site").mkdir()
    (tmp_path / "site/manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(RunError, match="is not a map"):
        make_map(tmp_path / "site", "new", overwrite=True)
    assert names_in(tmp_path / "site") == ["manifest.json"]


def test_foreign_files_in_a_folder_of_ours_are_named_and_kept(tmp_path):
    make_map(tmp_path / "map", "old")
    (tmp_path / "map/view_2.png").touch()
    make_map(tmp_path / "map", "newer", overwrite=True)
    (tmp_path / "map/thesis.tex").touch()
    (tmp_path / "map/notes").mkdir()
    with pytest.raises(RunError, match=r"not of a map: notes, thesis.tex; move them"):
        make_map(tmp_path / "map", "newest", overwrite=True)
    assert (tmp_path / "map/map.bt").read_text() == "newer"

    make_map(tmp_path / "map", "newest", overwrite=True, takes_over=True)
    assert names_in(tmp_path / "map") == ["manifest.json", "map.bt"]
    assert names_in(tmp_path) == ["map"]


def test_symbolic_links_are_not_followed(tmp_path):
    (tmp_path / "theirs").mkdir()
    partial_of(tmp_path / "map").symlink_to(tmp_path / "theirs", target_is_directory=True)
    with pytest.raises(RunError, match="is in the way"):
        make_map(tmp_path / "map", "new")
    assert not list((tmp_path / "theirs").iterdir())


def test_a_folder_that_cannot_be_renamed_is_told_in_a_line(tmp_path, monkeypatch):
    make_map(tmp_path / "map", "old")

    def busy(*_):
        raise OSError(errno.EBUSY, "Device or resource busy", "map", None, ".map.old")

    monkeypatch.setattr(atomic, "_exchange", busy)
    with pytest.raises(WriteError, match=rf"^{tmp_path}/map: cannot be replaced: Device or resource busy; "):
        make_map(tmp_path / "map", "new", overwrite=True)
    assert (tmp_path / "map/map.bt").read_text() == "old"
    assert (tmp_path / "map.partial/map.bt").read_text() == "new"


def test_a_folder_is_replaced_where_names_cannot_be_exchanged(tmp_path, monkeypatch):
    make_map(tmp_path / "map", "old")
    monkeypatch.setattr("mapper.runtime.atomic.ctypes.CDLL", lambda *_, **__: object())
    make_map(tmp_path / "map", "new", overwrite=True)
    assert (tmp_path / "map/map.bt").read_text() == "new"
    assert names_in(tmp_path) == ["map"]


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EIO])
def test_what_is_on_no_disk_needs_no_flush_and_a_failing_disk_is_told(monkeypatch, tmp_path, number):
    def fail(_handle):
        raise OSError(number, "it is so")

    path = tmp_path / "a.txt"
    write_text(path, "text")
    monkeypatch.setattr(atomic.os, "fsync", fail)
    if number == errno.EINVAL:  # what the files of /proc, and folders on some network's disks, answer
        flush_to_disk(path)
    else:
        with pytest.raises(WriteError, match=r"a\.txt: cannot be written: it is so"):
            flush_to_disk(path)
