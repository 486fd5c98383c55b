"""The tests' own architecture: what they share is in tests/support, and no two files have one name.

Only tests/fuzz, which is a program too, has modules of its own.
"""

from collections import Counter

from tests.support.imports import imports_of
from tests.support.paths import ROOT

FILES = sorted((ROOT / "tests").rglob("*.py"))
TESTS = [path for path in FILES if path.name.startswith("test_")]


def test_no_test_imports_another_test():
    for path in FILES:
        for one in imports_of(path):
            for name in one.names:
                parts = name.split(".")
                is_test = any(part == "conftest" or part.startswith("test_") for part in parts)
                assert not is_test, f"{path}:{one.line} imports {name}; share it in tests/support"
                shared = ("", "support", "fuzz") if "fuzz" in path.parts else ("", "support")
                assert parts[0] != "tests" or "".join(parts[1:2]) in shared, name


def test_every_test_is_in_a_folder_and_has_a_name_of_its_own():
    counts = Counter(path.name for path in TESTS)
    assert [name for name, count in counts.items() if count > 1] == []
    assert [path.name for path in TESTS if path.parent == ROOT / "tests"] == []
