import importlib
import sys
from pathlib import Path

import pytest

from mapper.runtime import bytecode
from mapper.runtime.bytecode import has_bytecode, keep_bytecode


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module that was imported, with no bytecode kept."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(bytecode.compileall, "compile_dir", lambda *_, **__: None)
    (tmp_path / "imported_once.py").write_text("ANSWER = 42\n")
    imported = importlib.import_module("imported_once")
    monkeypatch.setattr(bytecode, "_imported", lambda: [sys, imported])
    yield imported
    del sys.modules["imported_once"]


def test_the_bytecode_of_an_imported_module_is_kept(module):
    assert not has_bytecode(module)
    keep_bytecode()
    assert has_bytecode(module)
    assert Path(module.__spec__.cached).is_file()


def test_a_folder_that_cannot_be_written_is_left(module, monkeypatch):
    def refuse(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(bytecode.py_compile, "compile", refuse)
    keep_bytecode()
    assert not has_bytecode(module)


def test_modules_without_source_need_none():
    assert has_bytecode(sys)
    assert has_bytecode(importlib.import_module("math"))


def test_the_whole_package_is_compiled(monkeypatch):
    compiled = []
    monkeypatch.setattr(bytecode.compileall, "compile_dir", lambda path, **_: compiled.append(path.name))
    monkeypatch.setattr(bytecode, "_imported", list)
    keep_bytecode()
    assert set(compiled) >= {"mapper"}
    assert len(compiled) in (1, 3)  # installed, or a source tree with its two links
