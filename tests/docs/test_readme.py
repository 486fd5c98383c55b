"""What README.md shows is run, on a small log under the name that the README uses."""

import re
import shlex
import subprocess
import sys

import pytest

from mapper.run.files import RUN_FILES
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import write_lidar_log
from tests.support.command_line import mapper
from tests.support.paths import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
LOG = "rgbd_dataset_freiburg1_xyz"
SCANS = "kitti_00"

QUICKER = {"compare": ["--last", "6", "--pairs", "1"]}
"""What is added to a command that takes minutes; its rows are the same."""

BLOCK = re.compile(r"<!-- run[^>]*-->\n```(console|python)\n(.*?)```", re.DOTALL)
FILES = re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", README, re.DOTALL)
CONSOLE = [text for kind, text in BLOCK.findall(README) if kind == "console"]
PYTHON = [text for kind, text in BLOCK.findall(README) if kind == "python"]


def commands_in(block):
    """Pairs of a command and the output that the README claims for it."""
    for part in block.split("$ ")[1:]:
        command, _, output = part.partition("\n")
        yield command, output.splitlines()


def row_names(lines):
    """The first column of a table: what stands before two spaces."""
    return [re.split(r"\s{2,}", line)[0] for line in lines if not line.startswith(" ")]


@pytest.fixture(scope="module")
def place(desk_log, tmp_path_factory):
    place = tmp_path_factory.mktemp("readme")
    (place / LOG).symlink_to(desk_log)
    sensor = LidarSensorConfig(rings=32, azimuth_steps=450, motion_distortion=False)
    write_lidar_log(place / SCANS, STREET.model_copy(update={"duration_s": 1.2, "sensor": sensor}))
    (place / SCANS / "times.txt").unlink()  # the real one tells no stamps either
    (place / "configs").symlink_to(ROOT / "configs")
    for name, text in FILES:
        (place / name).write_text(text)
    return place


def test_there_is_something_to_run():
    assert len(CONSOLE) >= 2
    assert len(PYTHON) >= 1


@pytest.mark.slow
@pytest.mark.parametrize("block", CONSOLE)
def test_commands_print_the_rows_that_the_readme_shows(place, block, monkeypatch):
    monkeypatch.chdir(place)
    for command, shown in commands_in(block):
        program, verb, *words = shlex.split(command)
        assert program == "mapper"
        run = in_a_process_of_its_own if verb == "build" and block == CONSOLE[0] else mapper
        printed = run(verb, *words, *QUICKER.get(verb, ())).stdout
        if len(shown) > 1:
            assert row_names(printed.splitlines()) == row_names(shown), command
        else:
            assert bool(printed.strip()) == bool(shown), command


def in_a_process_of_its_own(*arguments):
    """As a user runs it; the others are spared the seconds that its imports take."""
    start = [sys.executable, "-c", "from cli.main import main; main()"]
    done = subprocess.run([*start, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize("code", PYTHON)
def test_the_library_example_works(place, code, monkeypatch, capsys):
    monkeypatch.chdir(place)
    exec(compile(code, "README.md", "exec"), {})
    assert 0.1 < float(capsys.readouterr().out) < 3.0


def test_the_files_it_names_exist():
    for name in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / name).is_file(), name


def test_the_set_up_commands_exist_and_ci_calls_the_second():
    demo, test = re.findall(r"^bash (scripts/\S+)", README, re.MULTILINE)
    assert (ROOT / demo).is_file()
    assert f"bash {test}" in (ROOT / ".ci" / "run").read_text()
    assert subprocess.run(["bash", "-n", ROOT / test], check=False).returncode == 0


def test_the_files_of_a_run_are_listed_as_the_code_lists_them():
    rows = [f"| {', '.join(f'`{name}`' for name in files.names)} | {files.content} |" for files in RUN_FILES]
    assert "\n".join(rows) in README


@pytest.mark.slow  # only after the first commands
def test_every_file_of_a_run_is_explained(place):
    named = {name for files in RUN_FILES for name in files.names}
    for path in (place / "runs" / "xyz").iterdir():
        assert path.name in named, path.name
