"""No import cycles, imports inside functions included: every module can be read after those it imports."""

from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path

import pytest

from tests.support.imports import imports_of
from tests.support.paths import ROOT

PREFIXES = {"mapper": "", "evaluators": "mapper.", "cli": "mapper."}


def modules() -> dict[str, Path]:
    """Return the path of each of our modules."""
    found = {}
    for package, prefix in PREFIXES.items():
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if parts[:2] not in {("mapper", "cli"), ("mapper", "evaluators")}:  # links to these packages
                found[prefix + ".".join(parts).removesuffix(".__init__")] = path
    return found


def importing() -> dict[str, set[str]]:
    """Return the modules that each module imports; a name that is no module is one of its parent's."""
    known = modules()
    graph: dict[str, set[str]] = {}
    for module, path in known.items():
        names = [name for one in imports_of(path) if not one.for_types for name in one.names]
        found = {name if name in known else name.rpartition(".")[0] for name in names}
        graph[module] = (found & known.keys()) - {module}
    return graph


def test_there_is_no_import_cycle():
    graph = importing()
    assert "mapper.octree.queries" in graph["mapper.octree.map"]
    assert "mapper.octree.slice" in graph["mapper.octree.queries"]  # imported inside a method
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail("; ".join(f"{b} imports {a}" for a, b in pairwise(error.args[1])))
