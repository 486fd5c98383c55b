"""What README.md and the pages show is run, on small logs under the names that they use."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mapper.run.files import RUN_FILES
from mapper.simulation import write_tum_log
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import write_lidar_log
from tests.support.command_line import mapper
from tests.support.desk import DESK
from tests.support.pages import OMITTED, PAGES, blocks_of, files_of, omits_rows_of, page_name
from tests.support.paths import ROOT

LOG = "rgbd_dataset_freiburg1_xyz"
SCANS = "kitti_00"
TEXTS = {page_name(path): path.read_text(encoding="utf-8") for path in PAGES}
RUN_PAGES = [name for name, text in TEXTS.items() if list(blocks_of(text))]

QUICKER = {
    "compare": ["--last", "3", "--pairs", "1"],
    "sweep": ["--processes", "1"],
    "synth": ["--seconds", "4"],
}
"""What is added to a command that takes minutes, or imports all in other processes; its rows are the same."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """The folder with the logs: of 21 frames, of which every second one is enough for a map, and of scans."""
    folder = tmp_path_factory.mktemp("logs")
    write_tum_log(folder / LOG, DESK.model_copy(update={"duration_s": 1.35}))
    sensor = LidarSensorConfig(rings=32, azimuth_steps=450, motion_distortion=False)
    write_lidar_log(folder / SCANS, STREET.model_copy(update={"duration_s": 1.6, "sensor": sensor}))
    (folder / SCANS / "times.txt").unlink()  # the real one tells no stamps either
    return folder


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The runs that pages have built, and what was printed, by their commands: pages build the same ones."""
    return tmp_path_factory.mktemp("built"), {}


@pytest.fixture
def place(logs, tmp_path, request, monkeypatch):
    """A folder for a page, with the logs, the configurations and the files that it shows."""
    for name in (LOG, SCANS):
        (tmp_path / name).symlink_to(logs / name)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    for name, text in files_of(TEXTS[request.getfixturevalue("page")]).items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_there_is_something_to_run():
    assert len(RUN_PAGES) > 8
    assert "README.md" in RUN_PAGES
    assert sum(len(block.commands) for text in TEXTS.values() for block in blocks_of(text)) > 20


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN_PAGES)
def test_blocks_run_and_print_the_rows_that_the_page_shows(page, place, built, capsys):
    for block in blocks_of(TEXTS[page]):
        if "real logs" in block.marks:
            continue
        if block.kind == "python":
            exec(compile(block.text, page, "exec"), {})
            assert capsys.readouterr().out.strip()
            continue
        for command in block.commands:
            printed = run(command, built)
            if "free rows" not in block.marks:
                assert_alike(command, printed)
    if page == "README.md":
        named = {name for files in RUN_FILES for name in files.names}
        assert {path.name for path in (place / "runs" / "xyz").iterdir()} <= named


def run(command, built):
    """Run a command and return what it prints."""
    program, verb, *words = command.words
    assert program == "mapper"
    if verb == "build":
        return built_or_copied(words, *built)
    return mapper(verb, *words, *QUICKER.get(verb, ())).stdout


def built_or_copied(words, folder, runs):
    """Build, the first time as a user does, or copy the run that a page has built with the same words."""
    out, key = Path(words[words.index("--out") + 1]), tuple(word for word in words if word != "--quiet")
    if key not in runs:
        printed = mapper("build", *key).stdout if runs else in_a_process_of_its_own("build", *key)
        runs[key] = shutil.copytree(out, folder / str(len(runs))), printed
    else:
        shutil.copytree(runs[key][0], out)
    return "" if "--quiet" in words else runs[key][1]


def in_a_process_of_its_own(*arguments):
    """As a user runs it; the others are spared the seconds that its imports take."""
    start = [sys.executable, "-c", "from mapper.cli.main import main; main()"]
    done = subprocess.run([*start, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_alike(command, printed):
    lines = printed.splitlines()
    if len(command.shown) > 1:
        assert omits_rows_of(command.shown, lines), f"{command.text} prints\n{printed}"
    else:
        assert bool(printed.strip()) == bool(command.shown), command.text


def test_rows_are_compared_but_for_those_that_are_omitted():
    printed = ["frames  3", "octree  5", "   more", "in      runs/xyz", "verdict  trusted"]

    assert omits_rows_of(["frames  9", "octree  1", "in  x", "verdict  doubtful"], printed)
    assert omits_rows_of(["frames  9", OMITTED, "verdict  doubtful"], printed)
    assert omits_rows_of(["frames  9", OMITTED, "in  x", OMITTED], printed)
    assert not omits_rows_of(["frames  9", "octree  1"], printed)
    assert not omits_rows_of(["octree  1", OMITTED], printed)
    assert not omits_rows_of(["frames  9", OMITTED, "in  x"], printed)
    assert not omits_rows_of(["frames  9", OMITTED, "loops  x", OMITTED], printed)


def test_the_set_up_commands_exist_and_ci_calls_the_second():
    demo, test = re.findall(r"^bash (scripts/\S+)", TEXTS["README.md"], re.MULTILINE)[:2]
    assert (ROOT / demo).is_file()
    assert f"bash {test}" in (ROOT / ".ci" / "run").read_text()
    assert subprocess.run(["bash", "-n", ROOT / test], check=False).returncode == 0


def test_the_files_of_a_run_are_listed_as_the_code_lists_them():
    rows = [f"| {', '.join(f'`{name}`' for name in files.names)} | {files.content} |" for files in RUN_FILES]
    assert "\n".join(rows) in TEXTS["docs/formats.md"]


def test_the_readme_is_short():
    assert len(TEXTS["README.md"].splitlines()) <= 150
