import re
from contextlib import contextmanager

import pytest

from mapper.core.errors import DependencyError
from mapper.doctor import machine
from mapper.pipeline import warm_up
from mapper.pipeline.warm_up import KERNELS, compile_kernels
from mapper.runtime.progress import Silent
from tests.support.command_line import invoke
from tests.support.paths import ROOT


class Counts(Silent):
    """Keeps the counts that are reported."""

    def __init__(self):
        self.reported = []

    @contextmanager
    def stage(self, name):
        assert name == "compile"
        yield lambda *counts: self.reported.append(counts)


@pytest.fixture(autouse=True)
def in_process(monkeypatch):
    monkeypatch.setattr(warm_up, "processors", lambda: 1)


@pytest.mark.slow
def test_both_sensors_logs_are_built(monkeypatch):
    built = []
    build = warm_up._build

    def build_and_note(folder, name, *overrides):
        build(folder, name, *overrides)
        built.append(sorted(path.name for path in (folder / name).iterdir()))

    monkeypatch.setattr(warm_up, "_build", build_and_note)
    kept = []
    monkeypatch.setattr(warm_up, "keep_bytecode", lambda: kept.append(len(built)))
    progress = Counts()
    compile_kernels(progress=progress)
    assert all("map.octree" in files for files in built)
    assert len(built) == 3
    assert kept == [2, 3]  # after the builds of each sensor, which import what is kept
    assert progress.reported[-1] == (KERNELS, KERNELS)


def test_a_build_that_fails_is_told(monkeypatch):
    def fail(_folder):
        raise OSError("no space left")

    monkeypatch.setattr(warm_up, "_build_lidar", fail)
    monkeypatch.setattr(warm_up, "_build_rgbd", lambda _folder: None)
    with pytest.raises(DependencyError, match="that compiles kernels failed: OSError: no space left"):
        compile_kernels()


def test_kernels_are_counted_once_however_often_they_were_compiled(monkeypatch, tmp_path):
    folder = tmp_path / "octree_0"
    folder.mkdir()
    for name in ("kernels._add-12.py311.nbi", "kernels._add-15.py311.nbi", "kernels._add-12.py311.1.nbc"):
        (folder / name).touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert machine.compiled_kernels() == {folder / "kernels._add"}


def test_the_bar_has_room_for_no_more_kernels_than_there_are():
    there = sum(
        len(re.findall(r"^ *@njit\(.*cache=True", path.read_text(), re.MULTILINE))
        for path in (ROOT / "mapper").rglob("*.py")
    )
    assert there / 2 < KERNELS <= there


def test_the_verb_compiles_and_says_how_many_there_are(monkeypatch):
    monkeypatch.setattr(warm_up, "compile_kernels", lambda **_: None)
    result = invoke("doctor", "--warm")
    assert re.search(r"numba cache +\d+ compiled kernels kept in ", result.stdout)

    refused = invoke("doctor", "run", "--warm")
    assert (refused.exit_code, refused.stderr) == (
        1,
        "mapper: RUN run: has no meaning with --warm; it compiles the kernels of all builds\n",
    )
