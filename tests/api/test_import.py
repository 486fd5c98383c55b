"""``import mapper`` loads nothing; its names are there for completion and for type checkers."""

import ast
import subprocess
import sys

import pytest

import mapper
from tests.support.paths import ROOT

TREE = ast.parse((ROOT / "mapper" / "__init__.py").read_text(encoding="utf-8"))


def modules_after(statement):
    """Names of the modules that a fresh interpreter has loaded by a statement."""
    code = f"import sys; before = set(sys.modules); {statement}; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


def test_importing_and_listing_the_names_loads_no_other_module_of_ours_and_no_library():
    loaded = modules_after("import mapper; dir(mapper)")
    assert {name for name in loaded if name.partition(".")[0] not in sys.stdlib_module_names} == {"mapper"}


def test_a_run_is_opened_without_what_draws_or_evaluates_it():
    """The two imports against the order of the layers are made when they are used."""
    asked = "import mapper; mapper.build; assert 'mapper.evaluators' not in sys.modules; mapper.open_run"
    loaded = modules_after(f"{asked}, mapper.evaluate")
    assert "mapper.run.folder" in loaded
    assert not {"mapper.export.picture", "matplotlib.pyplot", "gtsam", "open3d"} & loaded


@pytest.mark.parametrize("name", mapper.__all__)
def test_every_name_is_what_its_module_has(name):
    value = getattr(mapper, name)
    assert value.__name__ == name
    assert value.__doc__
    assert name in dir(mapper)


def test_type_checkers_see_the_same_names():
    (block,) = (node for node in TREE.body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    seen = {(alias.name, node.module) for node in imports for alias in node.names}
    assert seen == {(name, mapper._HOMES[name]) for name in mapper.__all__}
    assert list(mapper._HOMES) == mapper.__all__


def test_other_names_are_refused_as_python_does():
    with pytest.raises(AttributeError, match="module 'mapper' has no attribute 'buidl'") as caught:
        mapper.buidl  # noqa: B018
    assert (caught.value.name, caught.value.obj) == ("buidl", mapper)  # of which it makes "Did you mean"
