"""Completion of the command line, asked as the shells ask."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from mapper.cli import completion
from mapper.cli.completion import SCRIPTS, candidates, run_folders, words_of
from mapper.cli.main import app
from tests.support.command_line import HEAVY, mapper

COMMAND = typer.main.get_command(app)
PROGRAM = f"#!/bin/sh\nexec {sys.executable} -c 'from mapper.cli.main import main; main()' \"$@\"\n"


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A home folder of its own, with three runs and a log in the present one."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "ZDOTDIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    for run in ("runs/xyz", "runs/street", "runs/broken.partial", "alone"):
        (tmp_path / run).mkdir(parents=True)
        (tmp_path / run / "manifest.json").write_text("{}")
    (tmp_path / "logs" / "xyz").mkdir(parents=True)
    return home


def completed(*words):
    return [value for value, _ in candidates(COMMAND, words)]


@pytest.mark.parametrize(
    ("words", "values"),
    [
        (["bui"], ["build"]),
        (["sensor", "line-laser-a"], ["line-laser-accuracy"]),
        (["build", "log", "--ov"], ["--overwrite"]),
        (["eval", "run", "--align", "s"], ["se3", "sim3"]),
        (["export", "runs/xyz", "--as", "voxel"], ["voxels", "voxel-mesh"]),
        (["build", "log", "--set", "octree.res"], ["octree.resolution_m="]),
        (["build", "log", "--set", "oct"], ["octree.", "octomap."]),
        (["build", "log", "--set", "loops.kind=n"], ["loops.kind=none"]),
        (["build", "log", "--set", "octree.resolution_m="], []),
        (["config", "octree.resolution"], ["octree.resolution_m"]),
        (["view", ""], ["alone", "runs/street", "runs/xyz"]),
        (["view", "runs/x"], ["runs/xyz"]),
        (["view", "lo"], ["logs/"]),
        (["diff", "runs/xyz", "runs/s"], ["runs/street"]),
        (["localise", "logs/xyz", "--in", "al"], ["alone"]),
        (["build", ""], []),
        (["nonsense", ""], None),
    ],
)
def test_the_last_word_is_completed(words, values):
    if values is not None:
        assert completed(*words) == values
    else:
        assert "build" in completed(*words)


def test_settings_have_their_meaning_and_folders_that_cannot_be_read_complete_nothing(tmp_path):
    found = dict(candidates(COMMAND, ["build", "log", "--set", "octree."]))
    assert found["octree.resolution_m="].startswith("Edge of a voxel")
    assert run_folders("gone/") == []
    assert run_folders(f"{tmp_path}/runs/x") == [(f"{tmp_path}/runs/xyz", "")]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("mapper ", ["mapper", ""]),
        ("mapper bu", ["mapper", "bu"]),
        ("mapper view 'my run", ["mapper", "view", "my run"]),
        ("mapper build x --set a.b=", ["mapper", "build", "x", "--set", "a.b="]),
        ("", [""]),
    ],
)
def test_an_unfinished_line_is_taken_apart(line, words):
    assert words_of(line) == words


def asked(shell, *words, line=""):
    """What ``mapper`` prints to a shell's script, and the modules that it has loaded."""
    code = "import sys; from mapper.cli.main import main; main(); print(*sys.modules, file=sys.stderr)"
    environment = {**os.environ, completion.ASKED_BY: shell, completion.LINE: line}
    told = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True, env=environment
    )
    return told.stdout.splitlines(), {name.split(".")[0] for name in told.stderr.split()}


def test_completing_loads_nothing_heavy():
    for words in (["view", ""], ["build", "log", "--set", "octree."]):
        values, loaded = asked("zsh", *words)
        assert values
        assert not loaded & (HEAVY - {"pydantic", "numpy"}), "which Typer and the settings load"


def test_bash_gets_only_what_it_replaces():
    assert asked("bash", line="mapper build x --set loops.kind=n")[0] == ["none"]
    assert asked("bash", line="mapper build x --set loops.ki")[0] == ["loops.kind="]
    runs = [value for value, _ in run_folders("runs/")]
    assert asked("bash", line="mapper view runs/")[0] == runs


@pytest.mark.parametrize("shell", SCRIPTS)
def test_a_shell_is_made_to_read_its_script_once_and_what_it_started_with_stays(home, shell):
    start, before = home / f".{shell}rc", "alias ll='ls -l'"
    if shell != "fish":
        start.write_text(before)
    for _ in range(2):
        path = mapper("--install-completion", "--shell", shell).stdout.partition(":")[0]
    assert mapper("--show-completion", "--shell", shell).stdout == SCRIPTS[shell]
    assert Path(path).read_text() == SCRIPTS[shell]
    assert start.exists() is (shell != "fish")
    if start.exists():
        assert start.read_text().split("\n")[:2] == [before, f"source {path}"]


def test_an_unknown_shell_is_told(monkeypatch):
    monkeypatch.setattr("shellingham.detect_shell", lambda: ("tcsh", "/bin/tcsh"))
    assert mapper("--show-completion", status=1).stderr.startswith("mapper: shell tcsh: no completion for it")


@pytest.fixture
def program(home, monkeypatch):
    """``mapper`` on the PATH, as the scripts call it."""
    path = home / "bin" / "mapper"
    path.parent.mkdir()
    path.write_text(PROGRAM)
    path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{path.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))


def said_by(shell, *arguments):
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    return subprocess.run(
        [shell, *arguments], capture_output=True, text=True, check=False
    ).stdout.splitlines()


@pytest.mark.usefixtures("program")
def test_bash_completes():
    script = f"""{SCRIPTS["bash"]}
    COMP_LINE='mapper build log --set loops.kind=n' COMP_POINT=36
    _mapper_completion mapper; printf '%s\\n' "${{COMPREPLY[@]}}" """
    assert said_by("bash", "--norc", "-c", script) == ["none"]


@pytest.mark.usefixtures("program")
def test_fish_completes():
    script = f'{SCRIPTS["fish"]}\ncomplete -C "mapper build log --set loops.kind=n"'
    assert said_by("fish", "--no-config", "-c", script) == ["loops.kind=none"]


@pytest.mark.usefixtures("program")
def test_zsh_reads_the_script():
    assert said_by("zsh", "-f", "-c", f"{SCRIPTS['zsh']}\nprint $_comps[mapper]") == ["_mapper"]
