"""Where results go if no option tells."""

from pathlib import Path

import pytest

from mapper.core.errors import RunError
from mapper.runtime.atomic import locked
from mapper.runtime.result_paths import joined_names, name_of, place_of, result_path
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


@pytest.mark.parametrize(
    ("given", "found"), [("a/../../b", "../b"), (".", "."), ("", "."), ("runs/x", "runs/x")]
)
def test_a_result_has_a_name_of_its_own(here, given, found):
    assert result_path(Path(given)).resolve() == (here / found).resolve()
    assert result_path(Path(given)).name


@pytest.mark.parametrize("given", ["/", "/..", "a" * 300, "ä" * 130 + "/run"])
def test_what_cannot_be_a_name_is_refused(given):
    with pytest.raises(RunError, match="name of"):
        result_path(Path(given))


WITH_RESULTS = {
    "build": ["LOG"], "convert": ["LOG"], "solve": ["graph.g2o"], "diff": ["RUN", "RUN"],
    "export": ["RUN", "--as", "native"],
    "localise": ["LOG", "--in", "RUN"], "merge": ["RUN", "RUN"], "report": ["RUN"], "compare": ["LOG"],
    "sweep": ["sweep.toml"], "vocabulary train": ["LOG"], "demo": [],
}  # fmt: skip


@pytest.mark.parametrize("verb", WITH_RESULTS)
@pytest.mark.parametrize("out", ["/", "a" * 300])
def test_every_verb_refuses_a_result_without_a_name_in_one_line(verb, out):
    told = mapper(*verb.split(), *WITH_RESULTS[verb], "--out", out, status=1)
    assert [line.startswith("mapper: ") for line in told.stderr.splitlines()] == [True]


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
