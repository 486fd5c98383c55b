"""What Linux alone has is absent here, as on macOS or Windows; the rest has to do without."""

import mmap
import os
import subprocess
import sys

import numpy as np
import pytest

from mapper.octree.ray_casting import sparse_zeros
from mapper.octree.sparse_grid import FileArray
from mapper.run.folder import open_run
from mapper.runtime import atomic
from mapper.runtime.atomic import FolderKind, atomic_folder, flush_to_disk
from mapper.runtime.doctor import processors
from mapper.runtime.progress import forget_peak_memory, peak_memory_mb
from tests.support.paths import ROOT

MAC = """
import ctypes, mmap, os, pathlib, sys

del mmap.MADV_NOHUGEPAGE, os.sched_getaffinity, os.sched_setaffinity, os.posix_fadvise, os.posix_fallocate
is_there = pathlib.Path.exists
pathlib.Path.exists = lambda path: not str(path).startswith("/proc/") and is_there(path)


class Library(ctypes.CDLL):
    def __getattr__(self, name):
        if name in {"renameat2", "malloc_trim"}:
            raise AttributeError(name)
        return super().__getattr__(name)


ctypes.CDLL = Library
"""
WINDOWS = """
import builtins

is_imported = builtins.__import__


def without(name, globals=None, *rest, **named):
    if name in {"fcntl", "resource"} and (globals or {}).get("__name__", "").startswith("mapper."):
        raise ModuleNotFoundError(name)
    return is_imported(name, globals, *rest, **named)


builtins.__import__ = without
del os.O_DIRECTORY, os.O_NOFOLLOW, os.O_NONBLOCK
"""
IMPORT_ALL = """
import pkgutil
from importlib import import_module

import mapper

for module in pkgutil.walk_packages(mapper.__path__, "mapper."):
    import_module(module.name)
"""
BUILD = """
from mapper.pipeline.warm_up import _build_lidar

_build_lidar(pathlib.Path(sys.argv[1]) / "log")
"""


def run(code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


def test_an_array_in_a_file_grows_without_reserved_pages(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "posix_fallocate")
    array = FileArray(tmp_path, 512, np.float32)
    array.grown(300)[:] = 1.5
    rows = array.grown(2000)
    assert rows.shape == (2000, 512)
    assert (rows[:300] == 1.5).all()
    assert not rows[300:].any()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_every_module_can_be_imported():
    ended = run(MAC + WINDOWS + IMPORT_ALL)  # a build does without the first alone
    assert ended.returncode == 0, ended.stderr


@pytest.mark.slow
def test_a_build_needs_nothing_of_linux(tmp_path):
    ended = run(MAC + BUILD, str(tmp_path))
    assert ended.returncode == 0, ended.stderr
    manifest = open_run(tmp_path / "log_run").manifest
    assert manifest.counts.occupied > 1000
    assert manifest.counts.loops > 0
    assert manifest.solve.planes is not None
    assert manifest.gyroscope is not None


def test_memory_and_processors_are_counted_without_what_linux_has(monkeypatch):
    def no_handle(_name):
        raise TypeError("LoadLibrary() argument 1 must be str, not None")

    monkeypatch.delattr(mmap, "MADV_NOHUGEPAGE")
    zeros = sparse_zeros(5000)
    zeros[7] = 1
    assert (zeros.sum(), zeros.dtype, zeros.shape) == (1, np.uint8, (5000,))
    monkeypatch.delattr(os, "sched_getaffinity")
    assert processors() == os.cpu_count()
    monkeypatch.setattr("mapper.runtime.progress.ctypes.CDLL", no_handle)
    forget_peak_memory()
    monkeypatch.setattr("mapper.runtime.progress.Path.exists", lambda _path: False)
    assert peak_memory_mb() > 1.0
    monkeypatch.setitem(sys.modules, "resource", None)
    assert peak_memory_mb() == 0.0


def test_folders_are_replaced_without_locks(monkeypatch, tmp_path):
    monkeypatch.setattr(atomic, "_FOLDER", None)
    monkeypatch.setitem(sys.modules, "fcntl", None)
    kind = FolderKind("a map", manifest_keys=frozenset({"voxels"}), files=frozenset({"map.bt"}))
    for text in ("old", "new"):
        with atomic_folder(tmp_path / "map", kind, overwrite=True) as part:
            (part / "manifest.json").write_text('{"voxels": 1}')
            (part / "map.bt").write_text(text)
    assert (tmp_path / "map/map.bt").read_text() == "new"
    assert [child.name for child in tmp_path.iterdir()] == ["map"]
    flush_to_disk(tmp_path)
