"""The examples run as they are, on the logs that they simulate and on a log of one's own."""

import importlib.util
import json
import re
import runpy
import sys

import pytest

import mapper
from tests.support.paths import ROOT

EXAMPLES = ROOT / "examples"
SCRIPTS = ("map_and_query", "own_odometry", "compare_registrations")
NOTEBOOK = json.loads((EXAMPLES / "first_map.ipynb").read_text(encoding="utf-8"))


@pytest.fixture
def told_by(monkeypatch, capsys):
    """What an example prints, run as a script."""

    def run(name, *arguments):
        monkeypatch.syspath_prepend(EXAMPLES)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_every_example_is_run_here():
    names = {path.stem for path in EXAMPLES.glob("*.py")} - {"synthetic_logs"}
    assert names == set(SCRIPTS)
    assert {path.name for path in EXAMPLES.glob("*.ipynb")} == {"first_map.ipynb"}


@pytest.mark.slow
def test_a_log_of_one_s_own_is_mapped_and_queried(told_by, desk_log, tmp_path):
    told = told_by("map_and_query", desk_log, tmp_path / "run")
    assert "verdict: trusted" in told
    run = mapper.open_run(tmp_path / "run")
    assert f"octree: {len(run.octree.occupied())} occupied voxels" in told
    assert (tmp_path / "run.png").stat().st_size > 10_000


@pytest.mark.slow
def test_an_own_odometry_maps_a_simulated_street(told_by):
    told = told_by("own_odometry")
    errors = dict(re.findall(r"^(.*): \d+ poses, .* m, ATE (\S+) m$", told, re.MULTILINE))
    assert errors.keys() == {"own odometry", "toolkit"}
    assert all(float(error) < 0.5 for error in errors.values())


@pytest.mark.slow
def test_registrations_of_a_simulated_street_are_compared(told_by):
    told = told_by("compare_registrations")
    rows = [line.split() for line in told.splitlines()[1:]]
    trusted = {row[0]: float(row[2]) for row in rows if row[1] == "yes"}
    assert {"icp", "plane-icp", "gicp"} <= trusted.keys()
    assert max(trusted.values()) - min(trusted.values()) < 0.2


@pytest.fixture
def runner():
    spec = importlib.util.spec_from_file_location(
        "execute_notebook", ROOT / "scripts" / "execute_notebook.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def texts(notebook):
    """What each cell printed and returned, whatever the numbers."""
    return [
        [
            re.sub(r"\d+", "0", "".join(output.get("text") or output["data"]["text/plain"]))
            for output in cell["outputs"]
        ]
        for cell in notebook["cells"]
        if cell["cell_type"] == "code"
    ]


@pytest.mark.slow
def test_the_notebook_runs_and_shows_what_it_prints(runner, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert texts(runner.executed(NOTEBOOK)) == texts(NOTEBOOK)


def test_the_notebook_has_been_executed_and_has_pictures():
    code = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert any("image/png" in output.get("data", {}) for cell in code for output in cell["outputs"])
