"""Check that a code change changes no output: SHA-256 of everything that mapper's verbs write and print.

    python scripts/same_bytes.py record OUT.json [--tree DIR] [--data DIR] [--work DIR] [--only CASE …]
    python scripts/same_bytes.py compare BEFORE.json AFTER.json [--renamed OLD=NEW …] [--only CASE …]

``record`` runs the cases of same_bytes.toml with the code of a source tree, by default its own, in an emptied
work folder; it takes about 12 minutes. ``compare`` lists the differences, for text with the lines, and exits
with 1 if there are any; differences that vanish when OLD is replaced by NEW in names and texts do not count.

Two runs of one tree differ only in times, memory and paths. Before hashing, the numbers that same_bytes.toml
lists, with reasons, become "…", the paths of the work folder, the data and the tree become WORK, DATA and
TREE, and cells of sweeps, which are named by a hash of all settings, get their labels. All else counts.
"""

import argparse
import csv
import difflib
import fcntl
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SPEC = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
MAPPER = [sys.executable, "-P", "-c", "from mapper.cli.main import main; main()"]  # -P: not from here
NO_TIMES = ["--set", "mcap.frame_times=false"]

KEPT_CHARACTERS = 20_000
KEPT_LINES = 20
"""Shorter texts are kept beside their hash; of longer ones the first lines are, and the hash of the rest."""

NUMBERS, COLUMNS, LINES = (SPEC["dropped"][kind] for kind in ("numbers", "columns", "lines"))
NUMBER = re.compile(rf'("(?:{"|".join(NUMBERS)})": ?)(\{{[^}}]*\}}|\[[^]]*\]|"[^"]*"|[^,\s}}]+)')
LEAF = re.compile(r'(": ?)[^,\s}]+')
CELL = re.compile(r'"key": "([^"]*[0-9a-f]{12,})",\s*"label": "([^"]*)"')
BETWEEN_CELLS = re.compile(r" \| | & | {2,}|</t[hd]><t[hd][^>]*>")


def record(out: Path, tree: Path, data: Path, work: Path, only: list[str]) -> int:
    """Run the cases, each after those whose outputs it uses, and write what they gave after every one."""
    cases = chosen({name: text.strip().splitlines() for name, text in SPEC["cases"].items()}, only)
    places = {str(work): "WORK", str(data): "DATA", str(tree): "TREE"}
    paths = {name: path for path, name in places.items()}
    lock = work.with_suffix(".lock")
    if work.exists() and not lock.exists():
        sys.exit(f"{work}: was not made here, and would be emptied; choose another --work")
    with lock.open("w") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            sys.exit(f"{work}: another record is being made there; wait, or choose another --work")
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        for name, text in SPEC["files"].items():
            (work / name).write_text(replaced(text, paths), encoding="utf-8")
        git = ["git", "-C", str(tree), "describe", "--always", "--dirty", "--abbrev=40"]
        commit = subprocess.run(git, capture_output=True, encoding="utf-8", check=False).stdout.strip()
        found = {"tree": str(tree), "commit": commit, "python": sys.version, "cases": {}}
        for name, lines in cases.items():
            began, cpu_before = time.perf_counter(), sum(os.times()[2:4])
            (work / name).mkdir()
            printed = run_case([replaced(line, paths) for line in lines], work / name, tree)
            outputs = found["cases"][name] = outputs_of(work / name, printed, places)
            out.write_text(json.dumps(found, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
            seconds, cpu = time.perf_counter() - began, sum(os.times()[2:4]) - cpu_before
            print(f"{name:<16} {seconds:6.1f} s, CPU {cpu:6.1f} s, {len(outputs)} outputs", flush=True)
    return 0


def chosen(cases: dict[str, list[str]], only: list[str]) -> dict[str, list[str]]:
    """Return the cases that were asked for, all if none were, with those whose outputs they use."""
    if unknown := set(only) - set(cases):
        sys.exit(f"no such case: {', '.join(sorted(unknown))}; there are {', '.join(cases)}")
    wanted = set(only or cases)
    for name in reversed(cases):  # a case uses earlier ones only
        if name in wanted:
            wanted |= set(re.findall(r"\.\./(\w+)/", "\n".join(cases[name])))
    return {name: lines for name, lines in cases.items() if name in wanted}


def run_case(lines: list[str], folder: Path, tree: Path) -> dict[str, str]:
    """Run a case's commands in its folder; return what they printed, by its name in the record."""
    environment = os.environ | {"PYTHONPATH": str(tree), "COLUMNS": "110"}
    printed = {}
    for number, line in enumerate(lines, start=1):
        words = shlex.split(line)
        if words[0] == "copy":
            if (folder / words[1]).is_dir():  # else the verb that was to make it has said why it did not
                shutil.copytree(folder / words[1], folder / words[2])
            continue
        if words[0] in ("build", "demo") and "--onto" not in words:  # that goes by the first run's settings
            words += NO_TIMES
        done = subprocess.run(
            [*MAPPER, *words], cwd=folder, env=environment, capture_output=True, encoding="utf-8", check=False
        )
        printed[f"stdout {number}: {line}"] = done.stdout
        printed[f"stderr {number}: {line}"] = f"{done.stderr}exit status {done.returncode}\n"
    return printed


def outputs_of(folder: Path, printed: dict[str, str], places: dict[str, str]) -> dict[str, dict[str, str]]:
    """Return each output of a case: its hash, and its text where it has one."""
    contents = {name: text.encode() for name, text in printed.items()}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            contents[str(path.relative_to(folder))] = content_of(path)
    cells = b"\n".join(content for name, content in contents.items() if "/cells/" in name).decode()
    places = places | {key: f"[{label}]" for key, label in CELL.findall(cells)}
    return {
        replaced(name, places): described(content, places, is_csv=name.endswith(".csv"))
        for name, content in contents.items()
    }


def content_of(path: Path) -> bytes:
    """Return a file's bytes, or a text dump of it where its binary format has random ids or times in it."""
    if program := SPEC["dumps"].get(path.suffix):
        dump = subprocess.run([sys.executable, "-c", program, path], capture_output=True, check=False)
        return dump.stdout or dump.stderr
    return path.read_bytes()


def described(content: bytes, places: dict[str, str], *, is_csv: bool) -> dict[str, str]:
    """Return an output's hash, and, if it is text, all of it or its beginning."""
    try:
        text = content.decode()
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        return {"sha256": hashlib.sha256(content).hexdigest()}
    text = normalised(replaced(text, places), is_csv=is_csv)
    found = {"sha256": hashlib.sha256(text.encode()).hexdigest(), "text": text}
    if len(text) > KEPT_CHARACTERS:
        found["text"] = "".join(text.splitlines(keepends=True)[:KEPT_LINES])[:KEPT_CHARACTERS]
        found["rest"] = hashlib.sha256(text[len(found["text"]) :].encode()).hexdigest()
    return found


def normalised(text: str, *, is_csv: bool) -> str:
    """Return a text without the numbers that differ between two runs of the same code."""
    text = NUMBER.sub(lambda m: m[1] + (LEAF.sub(r"\1…", m[2]) if m[2].startswith("{") else "…"), text)
    for pattern, replacement in LINES:
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
    return without_columns(text, is_csv=is_csv)


def without_columns(text: str, *, is_csv: bool) -> str:
    """Return a text with … in the dropped columns of its tables: CSV, Markdown, LaTeX, HTML or aligned."""
    lines, drops = text.replace("<tr>", "\n<tr>").split("\n"), []
    for k, line in enumerate(lines):
        cells = next(csv.reader([line]), []) if is_csv else BETWEEN_CELLS.split(line)
        titles = [re.sub(r"<[^>]*>|[|\\]", "", cell).strip() for cell in cells]
        dropped = COLUMNS + NUMBERS if is_csv or "<th>" in line else COLUMNS
        if any(title in dropped for title in titles):
            drops = [title in dropped for title in titles]
        elif not line.strip() or "</thead>" in line:
            drops = []
        if len(cells) == len(drops):
            shown = zip(cells, drops, strict=True)
            lines[k] = "  ".join(re.sub("^[^<]*", "…", cell) if drop else cell for cell, drop in shown)
    return "\n".join(lines)


def compare(before: Path, after: Path, names: dict[str, str], only: list[str]) -> int:
    """Print what differs between two records, equal differences once; return 1 if anything does."""
    old = {replaced(name, names): output for name, output in outputs_in(before, only).items()}
    new = outputs_in(after, only)
    same, others = Counter(), defaultdict(list)
    for name in sorted(old.keys() | new.keys()):
        if name not in new or name not in old:
            others["only in BEFORE" if name in old else "only in AFTER"].append(name)
        elif old[name]["sha256"] == new[name]["sha256"]:
            same["the same"] += 1
        elif lines := difference(old[name], new[name], names):
            others[lines].append(name)
        else:
            same["the same once renamed"] += 1
    for what, where in others.items():
        print("\n".join([*where, f"    {what}\n"]))
    print(", ".join(f"{count} {what}" for what, count in same.items()), end="; ")
    print(f"{sum(map(len, others.values()))} not")
    return 1 if others else 0


def outputs_in(path: Path, only: list[str]) -> dict[str, dict[str, str]]:
    """Return the outputs of a record's cases, or of some of them."""
    cases = json.loads(path.read_text(encoding="utf-8"))["cases"].items()
    kept = [(case, outputs) for case, outputs in cases if case in only or not only]
    return {f"{case}/{name}": output for case, outputs in kept for name, output in outputs.items()}


def difference(old: dict[str, str], new: dict[str, str], names: dict[str, str]) -> str:
    """Return the lines that differ between two outputs; empty if they are the same once names are."""
    if "text" not in old or "text" not in new:
        return "other bytes"
    text, rest_differs = replaced(old["text"], names), old.get("rest") != new.get("rest")
    if text != old["text"] and text.split() == new["text"].split() and not rest_differs:
        return ""  # a longer name may break lines elsewhere
    lines = [*difflib.unified_diff(text.splitlines(), new["text"].splitlines(), n=0, lineterm="")][2:]
    if rest_differs:
        lines.append(f"… and what follows the first {KEPT_LINES} lines, of which only a hash is kept")
    return "\n    ".join(line for line in lines if not line.startswith("@@")) or "other line ends"


def replaced(text: str, names: dict[str, str]) -> str:
    """Return a text with each name replaced by another."""
    for old, new in names.items():
        text = text.replace(old, new)
    return text


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    recording = verbs.add_parser("record", help="run the cases and hash their outputs")
    recording.add_argument("out", type=Path)
    recording.add_argument("--tree", type=Path, default=ROOT, help="checkout whose code runs")
    recording.add_argument("--data", type=Path, default=ROOT.parent / "shared/data", help="the real logs")
    recording.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "same_bytes")
    comparing = verbs.add_parser("compare", help="list what differs between two records")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    comparing.add_argument("--renamed", nargs="+", metavar="OLD=NEW", default=[])
    for verb in (recording, comparing):
        verb.add_argument("--only", nargs="+", metavar="CASE", default=[])
    given = parser.parse_args()
    if given.verb == "compare":
        names = dict(pair.split("=", 1) for pair in given.renamed)
        return compare(given.before, given.after, names, given.only)
    return record(given.out, given.tree.resolve(), given.data.resolve(), given.work.resolve(), given.only)


if __name__ == "__main__":
    sys.exit(main())
