"""``python -m tests.fuzz --cases N [--seed S]``: read damaged inputs, and print those that end in a fault."""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.fuzz.corpus import FORMATS
from tests.fuzz.runner import Case, Runner, cases, for_each_case

_REPORT_S = 10.0


class Progress:
    """Outcomes so far, on the terminal every ten seconds, and when the last is to be expected."""

    def __init__(self, total: int) -> None:
        self.outcomes: Counter[str] = Counter()
        self._total, self._began = total, time.monotonic()
        self._reported = self._began

    def add(self, outcome: str) -> None:
        self.outcomes[outcome] += 1
        now, done = time.monotonic(), self.outcomes.total()
        if now - self._reported > _REPORT_S:
            self._reported = now
            left_s = (now - self._began) / done * (self._total - done)
            end = time.strftime("%H:%M:%S", time.localtime(time.time() + left_s))
            print(f"{done}/{self._total} {dict(self.outcomes)}, ends at {end}", file=sys.stderr)


def fuzz(runner: Runner, count: int, seed: int) -> int:
    """Read so many cases and print the faults; return how many there are."""
    progress, faults = Progress(count), 0

    def run(case: Case) -> None:
        nonlocal faults
        reading = runner.run_case(case)
        progress.add(reading.outcome)
        if reading.is_fault:
            faults += 1
            print(
                f"{case}: {reading.file}\n{reading.command}\n{reading.outcome}: {reading.detail}\n",
                flush=True,
            )

    for_each_case(cases(), count, seed, run)
    print(f"{progress.outcomes.total()} cases: {dict(progress.outcomes)}, {faults} faults")
    return faults


def main() -> int:
    """Run the cases; 1 if there are faults."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=1000, help="how many inputs to damage")
    parser.add_argument("--seed", type=int, default=0, help="of the cases; another seed is other damage")
    options = parser.parse_args()
    with TemporaryDirectory(prefix="mapper-fuzz-") as scratch, Runner(Path(scratch)) as runner:
        print(f"{len(FORMATS)} formats, {options.cases} cases", file=sys.stderr)
        return 1 if fuzz(runner, options.cases, options.seed) else 0


if __name__ == "__main__":
    sys.exit(main())
