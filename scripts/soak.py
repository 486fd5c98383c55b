"""Soak test: for a given time, builds and changes of a run that are killed, or meet a full disk or damage.

After every trial it checks that the earlier run is unchanged, that no file with a final name is incomplete,
and that the failure was reported in one line; now and then a trial runs to its end, and has to give the
reference's bytes. In trials of "resume" a build is killed repeatedly, resumes each time, and has to end in
these bytes, too.

Example: python scripts/soak.py --minutes 30 --folder /tmp/soak
         python scripts/soak.py --minutes 30 --folder /tmp/xyz --trials resume --log LOG
"""

import argparse
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from mapper.core.errors import MapperError
from mapper.run.file_checks import check_run
from mapper.run.folder import open_run
from mapper.runtime.atomic import partial_of

MAPPER = [sys.executable, "-c", "import sys; sys.argv[0] = 'mapper'; import mapper.cli.main as m; m.main()"]
LOG = [
    *("--path", "desk", "--seconds", "2", "--set", "frame_rate_hz=15", "--set", "width_px=320"),
    *("--set", "height_px=240", "--set", "texture_px_per_m=64"),
]
REPEATABLE = ["--set", "mcap.frame_times=false"]
MEASURED = {"manifest.json", "frame_ms.csv"}
"""Files of a run that hold times, so that they differ from run to run."""
ENDINGS = {-signal.SIGKILL: "killed", 143: "SIGTERM", 130: "SIGINT", -signal.SIGTERM: "SIGTERM", 0: "done"}
LONGEST_S = 600.0


@dataclass
class Soak:
    """A folder with a log, the reference run of it, and the run that is worked on.

    Attributes:
        folder: Scratch.
        random: Draws all trials.
        counts: How the trials ended.
        faults: What should not be, a line each.
        log: The log; a synthetic one is made where there is none.
        settings: Arguments of every build.
        kinds: Kinds of trials that are drawn.
        kills: How often a build was killed and went on.
        seconds: How long a verb took that was left to its end.
    """

    folder: Path
    random: random.Random
    log: Path
    settings: list[str] = field(default_factory=lambda: [*REPEATABLE])
    kinds: str = "all"
    kills: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.reference, self.run = (self.folder / name for name in ("reference", "run"))
        self.duration_s = 0.0

    def prepare(self) -> None:
        """Make the log, the reference run and a copy of it, unless an earlier soak left them."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if not self.log.exists():
            self._must("synth", self.log, *LOG)
        if not self.reference.exists():
            self._must("build", self.log, "--out", self.reference, *self.settings)
        began = time.monotonic()
        self._must("build", self.log, "--out", self.run, "--overwrite", "--fresh", *self.settings)
        self.duration_s = time.monotonic() - began
        self._compare("first build")

    def trial(self) -> None:
        """Draw one trial, run it and check what it left."""
        kinds: list[Callable[[], None]] = [self._resumed]
        if self.kinds == "all":
            kinds += [self._killed, self._killed, self._full_disk, self._damaged_log]
        self.random.choice(kinds)()

    def _work(self) -> list[object]:
        works: list[list[object]] = [
            ["build", self.log, "--out", self.run, "--overwrite", "--quiet", *self.settings],
            ["fuse", self.run, "--quiet"],
            ["export", self.run, "--as", "costmap"],
            ["view", self.run, "--quiet"],
        ]
        return self.random.choices(works, weights=[4, 4, 1, 1])[0]

    def _killed(self) -> None:
        work = self._work()
        how = self.random.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
        after_s = self.random.uniform(0.0, 1.2) * self.seconds.get(str(work[0]), self.duration_s)
        began = time.monotonic()
        process = subprocess.Popen(
            [*MAPPER, *map(str, work)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        try:
            _, stderr = process.communicate(timeout=after_s)
            self.seconds[str(work[0])] = time.monotonic() - began
        except subprocess.TimeoutExpired:
            process.send_signal(how)
            _, stderr = process.communicate(timeout=60.0)
        what = f"{' '.join(map(str, work[:1]))} {how.name} after {after_s:.1f} s"
        self._count(f"{work[0]} {ENDINGS.get(process.returncode, process.returncode)}")
        if process.returncode not in ENDINGS or "Traceback" in stderr:
            self.faults.append(f"{what}: status {process.returncode}: {stderr}")
        self._compare(what)

    def _resumed(self) -> None:
        """Kill a build at random instants until it ends by itself, and compare the run with the reference."""
        out, kills = self.folder / "resumed", []
        for path in (out, partial_of(out)):
            shutil.rmtree(path, ignore_errors=True)
        command = [*MAPPER, "build", str(self.log), "--out", str(out), "--quiet", *self.settings]
        began = time.monotonic()
        while not out.exists():
            # Longer each time, so that it ends even where starting takes most of the time.
            after_s = self.random.uniform(0.0, 0.7 + 0.1 * len(kills)) * self.duration_s
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            try:
                _, stderr = process.communicate(timeout=after_s)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                kills.append(round(after_s, 2))
                continue
            if process.returncode:
                self.faults.append(f"resume after kills at {kills} s: status {process.returncode}: {stderr}")
                return
        self.duration_s = 0.5 * (self.duration_s + time.monotonic() - began)  # the machine may be busy
        self.kills += len(kills)
        known = len(self.faults)
        self._compare(f"resume after kills at {kills} s", out)
        self._count(f"resume: {'equal' if len(self.faults) == known else 'DIFFERENT'}")
        print(f"{self.kills} kills in {self.counts.total()} builds that went on", flush=True)

    def _full_disk(self) -> None:
        work = self._work()
        blocks = int(2 ** self.random.uniform(0.0, 12.0))  # of 1 kB
        done = self._completed(
            ["sh", "-c", f'ulimit -f {blocks} && exec "$@"', "sh", *MAPPER, *map(str, work)]
        )
        what = f"{work[0]} with files of {blocks} kB at most"
        self._count(f"{work[0]}, full disk: status {done.returncode}")
        if done.returncode not in (0, 1) or done.stderr.count("mapper: ") > 1 or "Traceback" in done.stderr:
            self.faults.append(f"{what}: status {done.returncode}: {done.stderr}")
        self._compare(what)

    def _damaged_log(self) -> None:
        log, out = self.folder / "damaged", self.folder / "damaged_run"
        for path in (log, out, partial_of(out)):
            shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(self.log, log)
        damage = [self._damage(log) for _ in range(self.random.randint(1, 4))]
        done = self._completed([*MAPPER, "build", str(log), "--out", str(out), "--quiet"])
        what = f"build of a log with {', '.join(damage)}"
        self._count(f"damaged log: status {done.returncode}")
        if done.returncode not in (0, 1) or "Traceback" in done.stderr:
            self.faults.append(f"{what}: status {done.returncode}: {done.stderr}")
        if done.returncode == 0:
            self._check(out, what)
        elif out.exists():
            self.faults.append(f"{what}: failed, but {out} is there")

    def _damage(self, log: Path) -> str:
        path = self.random.choice(sorted(path for path in log.rglob("*") if path.is_file()))
        how = self.random.choice(["cut", "bits", "gone", "empty"])
        data = bytearray(path.read_bytes())
        if how == "gone":
            path.unlink()
        elif how == "cut":
            path.write_bytes(data[: self.random.randrange(len(data) + 1)])
        elif how == "empty":
            path.write_bytes(b"")
        else:
            for _ in range(self.random.randint(1, 20) if data else 0):
                data[self.random.randrange(len(data))] ^= 1 << self.random.randrange(8)
            path.write_bytes(data)
        return f"{path.relative_to(log)} {how}"

    def _compare(self, what: str, run: Path | None = None) -> None:
        """Check a run, and its bytes against the reference; None is the run that is worked on."""
        run = run or self.run
        self._check(run, what)
        for path in sorted(self.reference.iterdir()):
            ours = run / path.name
            if path.name not in MEASURED and (not ours.is_file() or ours.read_bytes() != path.read_bytes()):
                self.faults.append(f"{what}: {path.name} is not the reference's")

    def _check(self, run: Path, what: str) -> None:
        try:
            open_run(run)
            findings = check_run(run)
        except (MapperError, OSError) as error:
            self.faults.append(f"{what}: {error}")
            return
        # A process that was killed may leave a temporary file, which the doctor reports; nothing else.
        wrong = [finding for finding in findings if finding.verdict == "failed"]
        self.faults += [f"{what}: {finding.name}: {finding.detail}" for finding in wrong]

    def _count(self, ending: str) -> None:
        self.counts[ending] += 1

    def _completed(self, command: list[str]) -> "subprocess.CompletedProcess[str]":
        try:
            return subprocess.run(command, capture_output=True, text=True, check=False, timeout=LONGEST_S)
        except subprocess.TimeoutExpired:
            return subprocess.CompletedProcess(command, -1, "", f"hangs: no end after {LONGEST_S:g} s")

    def _must(self, *arguments: object) -> None:
        done = self._completed([*MAPPER, *map(str, arguments)])
        if done.returncode:
            raise SystemExit(f"soak: {arguments[0]} failed: {done.stderr}")


def main() -> None:
    """Run trials until the time is over; the exit status is 1 if any left what it should not."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=30.0, help="how long to go on")
    parser.add_argument("--folder", type=Path, required=True, help="scratch folder, kept")
    parser.add_argument("--seed", type=int, default=0, help="draws the trials")
    parser.add_argument("--trials", choices=("all", "resume"), default="all", help="which are drawn")
    parser.add_argument("--log", type=Path, help="an own log instead of the synthetic one")
    parser.add_argument("--set", action="append", default=[], help="setting of every build")
    options = parser.parse_args()
    folder = options.folder.resolve()
    settings = [*REPEATABLE, *(word for setting in options.set for word in ("--set", setting))]
    log = (options.log or folder / "log").resolve()
    soak = Soak(folder, random.Random(options.seed), log, settings, options.trials)
    soak.prepare()
    end = time.monotonic() + 60.0 * options.minutes
    while time.monotonic() < end:
        known = len(soak.faults)
        soak.trial()
        for fault in soak.faults[known:]:
            print(f"FAULT {fault}", flush=True)
        if len(soak.faults) > known:  # so that the next trial begins at a sound run
            shutil.rmtree(soak.run, ignore_errors=True)
            shutil.copytree(soak.reference, soak.run)
    for ending, count in sorted(soak.counts.items()):
        print(f"{count:5d}  {ending}")
    print(f"{sum(soak.counts.values())} trials, {soak.kills} builds killed that went on, ", end="")
    print(f"{len(soak.faults)} faults")
    sys.exit(bool(soak.faults))


if __name__ == "__main__":
    main()
