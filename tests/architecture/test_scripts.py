"""The names that benchmarks, examples and scripts import: nothing else runs all of them."""

import ast
import importlib
from pathlib import Path

import pytest

from tests.support.paths import ROOT

SCRIPTS = sorted(
    path for folder in ("benchmarks", "examples", "scripts") for path in (ROOT / folder).rglob("*.py")
)
OURS = ("mapper", "evaluators", "cli", "tests")


def exists(module: str, name: str) -> bool:
    if hasattr(importlib.import_module(module), name):
        return True
    try:
        return importlib.import_module(f"{module}.{name}") is not None
    except ModuleNotFoundError:
        return False


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_script_imports_names_that_exist(path: Path) -> None:
    imported = [
        (node.module, alias.name)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS
        for alias in node.names
    ]

    assert [f"{module}.{name}" for module, name in imported if not exists(module, name)] == []
