"""``python -m tests.fuzz --cases N [--seed S] [--lines]``: damaged inputs or command lines; prints faults."""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import strategies as st

from tests.fuzz.command_lines import Sandbox, lines
from tests.fuzz.corpus import FORMATS
from tests.fuzz.runner import Reading, Runner, cases, for_each_case

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


def fuzz(strategy: st.SearchStrategy[Any], run_case: Callable[[Any], Reading], count: int, seed: int) -> int:
    """Run so many cases and print the faults; return how many there are."""
    progress, faults = Progress(count), 0

    def run(case: Any) -> None:
        nonlocal faults
        reading = run_case(case)
        progress.add(reading.outcome)
        if reading.is_fault:
            faults += 1
            print(
                f"{case}: {reading.file}\n{reading.command}\n{reading.outcome}: {reading.detail}\n",
                flush=True,
            )

    for_each_case(strategy, count, seed, run)
    print(f"{progress.outcomes.total()} cases: {dict(progress.outcomes)}, {faults} faults")
    return faults


def main() -> int:
    """Run the cases; 1 if there are faults."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=1000, help="how many inputs to damage")
    parser.add_argument("--seed", type=int, default=0, help="of the cases; another seed is other damage")
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=[*FORMATS], help="which are damaged")
    parser.add_argument("--lines", action="store_true", help="command lines with hostile paths and files")
    options = parser.parse_args()
    with TemporaryDirectory(prefix="mapper-fuzz-") as scratch, Runner(Path(scratch)) as runner:
        print(f"{len(FORMATS)} formats, {options.cases} cases", file=sys.stderr)
        if options.lines:
            found = fuzz(lines(), Sandbox(Path(scratch), runner).run, options.cases, options.seed)
        else:
            found = fuzz(cases(options.formats), runner.run_case, options.cases, options.seed)
        return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
