"""Where results go if no option tells."""

from pathlib import Path

import pytest

from mapper.runtime.atomic import locked
from mapper.runtime.result_paths import joined_names, name_of, place_of
from tests.support.command_line import mapper


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_place_is_numbered_while_it_is_taken(here):
    usual = Path("runs/xyz")
    assert place_of(Path("told"), usual) == Path("told")
    assert place_of(None, usual) == usual
    usual.mkdir(parents=True)
    assert place_of(None, usual) == Path("runs/xyz-2")
    assert place_of(None, usual, overwrite=True) == usual
    (here / "runs/xyz-2.partial").mkdir()
    assert place_of(None, usual) == Path("runs/xyz-2"), "what a failed build left is used again"
    with locked(here / "runs/xyz-2.partial"):
        assert place_of(None, usual) == Path("runs/xyz-3"), "what another process fills is not"
    Path("log.mcap").touch()
    assert place_of(None, Path("log.mcap")) == Path("log-2.mcap")


def test_names_are_those_of_the_logs(here):
    Path("drive.mcap").touch()
    Path("v1.5").mkdir()
    assert [name_of(Path(name)) for name in ("drive.mcap", "v1.5", "gone/", ".", "..")] == [
        "drive", "v1.5", "gone", here.name, here.parent.name,
    ]  # fmt: skip
    assert joined_names([Path("a"), Path("b")]) == "a+b"
    assert joined_names([Path(name) for name in "abcde"]) == "a+b+c+2-more"


def test_builds_without_a_place_do_not_overwrite_each_other(desk_log):
    first = mapper("build", desk_log, "--last", 11).stdout
    again = mapper("build", desk_log, "--last", 11).stdout
    name = desk_log.name
    assert f"run       runs/{name} (" in first
    assert f"run       runs/{name}-2 (" in again
    mapper("build", desk_log, "--last", 11, "--overwrite", "--quiet")
    assert sorted(path.name for path in Path("runs").iterdir()) == [name, f"{name}-2"]


def test_other_verbs_have_usual_places_too(desk_run, desk_log):
    run = desk_run.path
    mapper("convert", desk_log, "--as", "mcap", "--quiet")
    mapper("convert", desk_log, "--as", "mbag", "--quiet")
    mapper("solve", run / "graph.g2o", "--quiet")
    mapper("diff", run, run, "--place", "built", "--quiet")
    mapper("merge", run, "--quiet")
    mapper("synth", "--seconds", 0.1, "--set", "width_px=64", "--set", "height_px=48", "--quiet")
    made = {str(path) for top in Path().iterdir() for path in top.iterdir()}
    assert made == {
        f"logs/{desk_log.name}.mcap", f"logs/{desk_log.name}", "logs/flat", "runs/graph",
        f"diffs/{run.name}+{run.name}", f"maps/{run.name}",
    }  # fmt: skip
