"""The names that benchmarks, examples and scripts import: nothing else runs all of them."""

import pkgutil
from pathlib import Path

import pytest

from tests.support.imports import imports_of
from tests.support.paths import ROOT

SCRIPTS = sorted(
    path for folder in ("benchmarks", "examples", "scripts") for path in (ROOT / folder).rglob("*.py")
)
OURS = ("mapper", "evaluators", "cli", "tests")


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_script_imports_names_that_exist(path: Path) -> None:
    for one in imports_of(path):
        for name in one.names if one.module.split(".")[0] in OURS else ():
            pkgutil.resolve_name(name)
