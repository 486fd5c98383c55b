"""Budgets: lines, files and numbers in constants of each folder. They may fall freely.

Raising one is for a commit that says what it bought. ``python -m tests.architecture.test_budget`` writes the
table as it is now.
"""

import ast
import json
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from mapper.config.build import BuildConfig
from mapper.core.config import Config, members_of
from tests.support.paths import ROOT

PATH = ROOT / "tests/architecture/budgets.json"
BUDGETS = json.loads(PATH.read_text())
REMEDY = "say in the commit what it bought, and raise it: python -m tests.architecture.test_budget"
MOST_NUMBERS = 4  # of a constant; longer ones are tables


def folder_of(path: Path) -> str:
    parts = path.relative_to(ROOT).parts
    return "/".join(parts[:2]) if parts[0] == "mapper" and len(parts) > 2 else parts[0]


def numbers_in(tree: ast.Module) -> Iterator[int]:
    for statement in tree.body:
        match statement:
            case ast.Assign(targets=[target], value=value) | ast.AnnAssign(target=target, value=value):
                names = [node.id for node in ast.walk(target) if isinstance(node, ast.Name)]
                if value is not None and names and all(name.isupper() for name in names):
                    count = sum(
                        isinstance(node, ast.Constant) and type(node.value) in (int, float)
                        for node in ast.walk(value)
                    )
                    yield count if count <= MOST_NUMBERS else 0


@cache
def measured() -> dict[str, Counter[str]]:
    found: dict[str, Counter[str]] = {}
    for top in ("mapper", "evaluators", "cli", "benchmarks", "scripts", "tests"):
        for path in sorted((ROOT / top).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            folder = found.setdefault(folder_of(path), Counter())
            folder.update(files=1, lines=text.count("\n"), numbers=sum(numbers_in(ast.parse(text))))
    return found


def settings_of(model: type[Config], seen: set[type[Config]]) -> int:
    """Return the number of settings of a model and of all that it holds."""
    if model in seen:
        return 0
    seen.add(model)
    inner = [member for field in model.model_fields.values() for member in members_of(field.annotation)]
    own = sum(not members_of(field.annotation) for field in model.model_fields.values())
    return own + sum(settings_of(member, seen) for member in inner)


@pytest.mark.parametrize("folder", sorted(BUDGETS.keys() - {"settings"}))
def test_a_folder_keeps_its_budget(folder):
    over = {
        name: f"{count}, want at most {BUDGETS[folder][name]}"
        for name, count in measured()[folder].items()
        if count > BUDGETS[folder][name]
    }
    assert not over, f"{folder}: {over}; {REMEDY}"


def test_settings_keep_their_budget():
    assert settings_of(BuildConfig, set()) <= BUDGETS["settings"]["numbers"], REMEDY


def test_the_budget_has_no_folder_that_is_gone():
    assert set(BUDGETS) - {"settings"} == set(measured())


if __name__ == "__main__":
    now = {folder: dict(counts) for folder, counts in sorted(measured().items())}
    now["settings"] = {"numbers": settings_of(BuildConfig, set())}
    PATH.write_text(json.dumps(now, indent=1) + "\n")
