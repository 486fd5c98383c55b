"""Run the commands that README.md and the pages show on real logs, and write their output into the pages.

    python scripts/refresh_outputs.py --logs DIR [--work DIR] [--page NAME …] [--slow]

DIR has the logs tum_fr1_xyz, kitti_00, mulran_kaist03 and posegraph/sphere2500.g2o. Each page gets its own
empty folder in the work folder, with these logs under the names that pages use. The blocks that the tests
run and those marked "real logs" are run; blocks marked "slow", which take many minutes, only with --slow. The
runs of the gallery are built only where --page names it: their figures and pictures are written anew.

A line "…" for omitted output stays, with as many rows before and after it as before. An output of ten lines
or fewer, or of which only two rows would be left out, is shown in full. The exit status is 1 if a command
failed; its output is then not changed.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from tests.support.pages import OMITTED, PAGES, Block, Command, blocks_of, files_of, page_name, row_names  # noqa: E402

LOGS = {
    "rgbd_dataset_freiburg1_xyz": "tum_fr1_xyz",
    "kitti_00": "kitti_00",
    "mulran_kaist03": "mulran_kaist03",
    "sphere2500.g2o": "posegraph/sphere2500.g2o",
}
MAPPER = [sys.executable, "-c", "from mapper.cli.main import main; main()"]
FEWEST_OMITTED = 3
"""Fewer rows are shown instead of being left out."""
MOST_SHORT_LINES = 10
"""An output of so few lines is shown whole."""
GALLERY = ROOT / "docs" / "gallery.md"
WIDTH_PX, QUALITY = 1000, 78
"""Largest side of a picture of the gallery, and its quality as JPEG: all together have less than 3 MB."""


def refresh(path: Path, logs: Path, work: Path, built: dict[tuple[str, ...], Path], *, slow: bool) -> int:
    """Run a page's blocks, rewrite the page, and return how many commands failed.

    Args:
        path: The page.
        logs: Folder with the logs.
        work: Folder to work in.
        built: Runs that were built without an output, by their commands: pages build the same ones.
        slow: Run blocks that are marked so, too.
    """
    page = path.read_text(encoding="utf-8")
    folder = _folder_for(path, page, logs, work)
    failed = 0
    texts: list[tuple[Block, str]] = []
    for block in blocks_of(page):
        if "slow" in block.marks and not slow:
            continue
        if block.kind == "python":
            failed += _run([sys.executable, "-c", block.text], folder) is None
            continue
        text = ""
        for command in block.commands:
            begun = time.perf_counter()
            printed = _copied(command, folder, built)
            if printed is None:
                printed = _run([*MAPPER, *command.words[1:]], folder)
            if printed == [] and command.words[1] == "build":
                built.setdefault(tuple(command.words), folder / _out_of(command))
            failed += printed is None
            shown = command.shown if printed is None else abridged(command.shown, printed)
            text += "".join(f"{line}\n" for line in [f"$ {command.text}", *shown])
            state = "failed" if printed is None else "same" if list(command.shown) == shown else "changed"
            print(
                f"{state:8} {time.perf_counter() - begun:6.1f} s  {page_name(path)}: {command.text}",
                flush=True,
            )
        texts.append((block, text))
    for block, text in reversed(texts):
        page = page[: block.start] + text + page[block.start + len(block.text) :]
    path.write_text(page, encoding="utf-8")
    return failed


def refresh_gallery(logs: Path, work: Path) -> int:
    """Build the runs of the gallery, write their pictures and counts, and return how many commands failed.

    The page itself states the commands, and the pictures: ``gallery/xyz_cloud.jpg`` is cloud.png of runs/xyz.
    """
    page = GALLERY.read_text(encoding="utf-8")
    folder, failed = _folder_for(GALLERY, page, logs, work), 0
    sections = re.split(r"^(?=## )", page, flags=re.MULTILINE)
    for number, section in enumerate(sections):
        commands = [shlex.split(line) for line in re.findall(r"^mapper (.+)$", section, re.MULTILINE)]
        if any(_run([*MAPPER, *words, "--quiet"], folder) is None for words in commands):
            failed += 1
            continue
        for name, picture in re.findall(r"\(gallery/([^_)]+)_(\w+)\.jpg\)", section):
            run = folder / "runs" / name
            sections[number] = re.sub(r"^\d+ frames tracked.*$", _counts(run), section, flags=re.MULTILINE)
            image = cv2.imread(str(run / f"{picture}.png"), cv2.IMREAD_COLOR)
            if (scale := WIDTH_PX / max(image.shape[:2])) < 1.0:
                image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            path = GALLERY.with_suffix("") / f"{name}_{picture}.jpg"
            cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    GALLERY.write_text("".join(sections), encoding="utf-8")
    return failed


def _counts(run: Path) -> str:
    manifest = json.loads((run / "manifest.json").read_text(encoding="utf-8"))
    counts, verdict = manifest["counts"], manifest["verdict"]
    stated = ": ".join([verdict["state"], *verdict["sentences"][:1]])
    return (
        f"{counts['tracked']} frames tracked, {counts['loops']} loops, {counts['leaves']} octree leaves, "
        f"{counts['cloud_points']} points in the cloud; {stated}."
    )


def _out_of(command: Command) -> str:
    return command.words[command.words.index("--out") + 1]


def _copied(command: Command, folder: Path, built: dict[tuple[str, ...], Path]) -> list[str] | None:
    """Copy the run of the same command on another page, if there is one; return what it printed, nothing."""
    run = built.get(tuple(command.words))
    if run is None:
        return None
    shutil.copytree(run, folder / _out_of(command))
    return []


def abridged(shown: Sequence[str], printed: Sequence[str]) -> list[str]:
    """Return what is printed, with rows left out where what is shown leaves some out.

    Args:
        shown: Lines of the page, of which some may be "…".
        printed: Lines that the command prints now.
    """
    if OMITTED not in (line.strip() for line in shown) or len(printed) <= MOST_SHORT_LINES:
        return list(printed)
    pieces: list[list[str]] = [[]]
    for line in shown:
        if line.strip() == OMITTED:
            pieces.append([])
        else:
            pieces[-1].append(line)
    rows = _rows(printed)
    head, *middle, tail = (_rows(piece) for piece in pieces)
    kept = {*range(min(len(head), len(rows))), *range(max(len(rows) - len(tail), 0), len(rows))}
    named = {name for piece in middle for row in piece for name in row_names(row)}
    kept |= {i for i, row in enumerate(rows) if named & set(row_names(row[:1]))}
    if len(rows) - len(kept) < FEWEST_OMITTED:
        return list(printed)
    lines: list[str] = []
    for i, row in enumerate(rows):
        if i in kept:
            lines += row
        elif lines[-1:] != [OMITTED]:
            lines.append(OMITTED)
    return lines


def _rows(lines: Sequence[str]) -> list[list[str]]:
    """Return the lines by row: one that begins with many spaces goes on with the row above."""
    rows: list[list[str]] = []
    for line in lines:
        if rows and re.match(r"\s{8}", line):
            rows[-1].append(line)
        else:
            rows.append([line])
    return rows


def _folder_for(path: Path, page: str, logs: Path, work: Path) -> Path:
    folder = work / path.stem
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, source in LOGS.items():
        (folder / name).symlink_to((logs / source).resolve())
    (folder / "configs").symlink_to(ROOT / "configs")
    for name, text in files_of(page).items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def _run(command: Sequence[str], folder: Path) -> list[str] | None:
    environment = {
        name: value for name, value in os.environ.items() if name not in ("COLUMNS", "FORCE_COLOR")
    }
    done = subprocess.run(
        command,
        cwd=folder,
        env={**environment, "NO_COLOR": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        print(done.stderr.strip()[-2000:], file=sys.stderr)
        return None
    text = done.stdout.replace(f"{folder.resolve()}/", "").replace(f"{folder}/", "")
    return [line.rstrip() for line in text.rstrip("\n").splitlines()]


def main() -> int:
    """Refresh the pages that were asked for, or all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=Path, required=True, help="folder with the recorded logs")
    parser.add_argument("--work", type=Path, help="folder to work in; a temporary one by default")
    parser.add_argument("--page", action="append", help="README.md or docs/NAME.md; may be given again")
    parser.add_argument("--slow", action="store_true", help="run blocks that take many minutes, too")
    arguments = parser.parse_args()
    names = [page_name(path) for path in PAGES]
    if unknown := set(arguments.page or ()) - set(names):
        parser.error(f"no page {', '.join(sorted(unknown))}; want one of {', '.join(names)}")
    if missing := [name for name in LOGS.values() if not (arguments.logs / name).exists()]:
        parser.error(f"{arguments.logs}: has no {', '.join(missing)}")
    with tempfile.TemporaryDirectory() as temporary:
        work = (arguments.work or Path(temporary)).resolve()
        built: dict[tuple[str, ...], Path] = {}
        failed = sum(
            refresh(path, arguments.logs, work, built, slow=arguments.slow)
            for path, name in zip(PAGES, names, strict=True)
            if arguments.page is None or name in arguments.page
        )
        if page_name(GALLERY) in (arguments.page or ()):
            failed += refresh_gallery(arguments.logs, work)
    if failed:
        print(f"{failed} commands failed; their outputs stay as they were", file=sys.stderr)
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
