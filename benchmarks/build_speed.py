"""Whole builds by this tree and by earlier commits, interleaved: CPU time, error, verdict, and ratios.

    python benchmarks/build_speed.py LOG… [--against COMMIT…] [--patch FILE] [--runs 3] [--set KEY=VALUE]
                                          [--packages FOLDER] [--peer]

A commit is unpacked by ``git archive``; ``--packages`` has libraries that only it needs. With ``--patch`` the
other tree is this commit with a patch, as for an ablation: a mechanism is worth what its removal changes.
``--peer`` runs KISS-ICP's pipeline on LiDAR logs beside ours. The first run of each is not counted, as it
compiles kernels. A ratio below 1 is in favour of this tree; losses are printed like gains.
"""

import argparse
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parent.parent
ERROR = re.compile(r"SE\(3\)-aligned ([\d.]+)")


@dataclass(frozen=True, slots=True)
class Tree:
    """A version of the program, and the commands' folder and libraries.

    Attributes:
        name: Name in the tables.
        folder: Folder that is imported from.
        packages: Folder of more libraries, or empty.
    """

    name: str
    folder: Path
    packages: str = ""


@dataclass(frozen=True, slots=True)
class Measurement:
    """One build."""

    cpu_s: float
    wall_s: float
    error: str
    frames: str
    verdict: str


def unpacked(commit: str, folder: Path, patch: Path | None = None) -> Path:
    """Unpack a commit into a folder, with a patch if there is one, and return the folder."""
    folder.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True)
    subprocess.run(["tar", "xf", "-"], cwd=folder, input=archive.stdout, check=True)
    if patch is not None:
        subprocess.run(["patch", "-p1", "--quiet", "--input", patch.resolve()], cwd=folder, check=True)
    return folder


def measure(tree: Tree, log: Path, settings: Sequence[str], out: Path) -> Measurement:
    """Build a log by a tree."""
    paths = [str(tree.folder), tree.packages]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    package = "mapper.cli" if (tree.folder / "mapper" / "cli").exists() else "cli"  # until 22 November
    command = [sys.executable, "-c", f"from {package}.main import main; main()", "build", str(log)]
    command += ["--out", str(out), *(word for setting in settings for word in ("--set", setting))]
    before, began_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    ended = subprocess.run(
        command, env=environment, cwd=tree.folder, capture_output=True, text=True, check=False
    )
    wall_s, after = time.monotonic() - began_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    shutil.rmtree(out, ignore_errors=True)
    said = ended.stdout + ended.stderr
    if not (frames := re.search(r"^frames\s+(.+)$", said, re.MULTILINE)):
        raise SystemExit(f"{tree.name}: {log}: {said.strip().splitlines()[-1]}")
    error, verdict = ERROR.search(said), re.search(r"^verdict\s+(.+)$", said, re.MULTILINE)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Measurement(
        cpu_s, wall_s, error[1] if error else "–", frames[1], verdict[1].strip() if verdict else "–"
    )


def measure_peer(log: Path) -> float:
    """Return the CPU seconds of KISS-ICP's pipeline alone, which makes no map, on one thread."""
    program = (
        "import sys; from pathlib import Path; sys.path.insert(0, 'benchmarks'); import lidar_odometry;"
        "from mapper.sources import open_source; log = open_source(Path(sys.argv[1]));"
        "print(lidar_odometry.measured(log, lidar_odometry.kiss_icp()))"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", program, str(log)], cwd=ROOT, capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def compare(trees: Sequence[Tree], log: Path, settings: Sequence[str], runs: int, scratch: Path) -> None:
    """Build a log by all trees in turn, and print a row for each."""
    found: dict[str, list[Measurement]] = {tree.name: [] for tree in trees}
    for run in range(runs + 1):
        for tree in trees:
            measured = measure(tree, log.resolve(), settings, scratch / "run")
            if run:
                found[tree.name].append(measured)
    own_s = median(one.cpu_s for one in found[trees[0].name])
    for name, measurements in found.items():
        cpu_s = sorted(one.cpu_s for one in measurements)
        wall_s = median(one.wall_s for one in measurements)
        first = measurements[0]
        print(
            f"| {log.name} | {name} | {median(cpu_s):.1f} ({cpu_s[0]:.1f} – {cpu_s[-1]:.1f}) | {wall_s:.1f} "
            f"| {own_s / median(cpu_s):.2f} | {first.error} | {first.frames} | {first.verdict} |"
        )


def main() -> None:
    """Print a table for each log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--against", nargs="*", default=[], metavar="COMMIT")
    parser.add_argument("--patch", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--set", nargs="*", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--packages", default="")
    parser.add_argument("--peer", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        trees = [Tree("this tree", ROOT)]
        trees += [
            Tree(commit, unpacked(commit, scratch / commit), given.packages) for commit in given.against
        ]
        if given.patch is not None:
            trees.append(Tree(given.patch.stem, unpacked("HEAD", scratch / "patched", given.patch)))
        print(
            f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors, {given.runs} runs\n"
        )
        print("| log | tree | CPU s (least – most) | wall s | ours / its CPU | ATE m | frames | verdict |")
        print("| --- | --- | ---: | ---: | ---: | ---: | --- | --- |")
        for log in given.logs:
            compare(trees, log, given.settings, given.runs, scratch)
            if given.peer:
                cpu_s = median(measure_peer(log) for _ in range(given.runs))
                print(f"| {log.name} | KISS-ICP, odometry alone | {cpu_s:.1f} | | | | | |")


if __name__ == "__main__":
    main()
