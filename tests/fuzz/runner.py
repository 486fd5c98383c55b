"""Runner of fuzz cases: a child process reads the inputs, and is replaced when one of them ends it."""

import json
import os
import select
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import hypothesis
import numpy as np
from hypothesis import strategies as st

from tests.fuzz.corpus import FORMATS, Corpus, commands_of
from tests.fuzz.damage import KINDS, damage

MEMORY_BYTES = 3 << 30
"""What the child may allocate for an input, beside a gigabyte of libraries."""
TIME_LIMIT_S = 60.0
"""Time for one input, of which most take some hundredths of a second."""
SECOND_LIMIT_S = 600.0
"""Time for an input that did not end within the first: on a busy machine a process may have waited."""


@dataclass(frozen=True)
class Case:
    """One damaged input; the same case is always the same damage to the same bytes.

    Attributes:
        format: A key of ``FORMATS``.
        damages: Kinds of damage, each to a file of its own choice.
        seed: Of the damage, and of the verb that reads it.
    """

    format: str
    damages: tuple[str, ...]
    seed: int


def cases(formats: Iterable[str] = tuple(FORMATS), damages: Iterable[str] = KINDS) -> st.SearchStrategy[Case]:
    """Return Hypothesis's strategy of cases: one damage mostly, of any kind to any format."""
    kinds = st.sampled_from(list(damages))
    one_or_two = st.one_of(st.tuples(kinds), st.tuples(kinds), st.tuples(kinds, kinds))
    return st.builds(Case, st.sampled_from(list(formats)), one_or_two, st.integers(0, (1 << 32) - 1))


def for_each_case(strategy: st.SearchStrategy[Any], count: int, seed: int, do: Callable[[Any], None]) -> None:
    """Do something with so many cases of a strategy, the same for the same seed."""

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        phases=[hypothesis.Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(strategy)
    def run(case: Any) -> None:
        do(case)

    run()


@dataclass(frozen=True)
class Reading:
    """What came of reading an input.

    Attributes:
        outcome: "read", "noted", "refused"; "error", "death" or "hang" are faults.
        detail: Notes, the message, or the traceback.
        file: What was damaged.
        command: What read it.
    """

    outcome: str
    detail: str
    file: str = ""
    command: str = ""

    @property
    def is_fault(self) -> bool:
        return self.outcome not in ("read", "noted", "refused")


class Child:
    """Child process that reads inputs; see ``tests.fuzz.child``."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Child":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def run(self, command: str, path: Path, *, limit_s: float = TIME_LIMIT_S) -> Reading:
        """Run a command of ``tests.fuzz.child``, with a path for each ``{}`` in it."""
        return self.ask([word.replace("{}", str(path)) for word in command.split()], limit_s=limit_s)

    def ask(self, words: Sequence[str], *, limit_s: float = TIME_LIMIT_S) -> Reading:
        """Run a command of ``tests.fuzz.child`` by its words."""
        process = self._process or self._begin()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(f"{json.dumps(words)}\n".encode())
        process.stdin.flush()
        if not select.select([process.stdout], [], [], limit_s)[0]:
            self._end()
            return Reading("hang", f"no answer within {limit_s:g} s")
        line = process.stdout.readline()
        if not line:
            code = process.wait()
            self._process = None
            return Reading("death", f"the process ended with {code}")
        return Reading(**json.loads(line))

    def _begin(self) -> subprocess.Popen[bytes]:
        root = Path(__file__).parents[2]
        paths = [str(root), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.child", str(MEMORY_BYTES)],
            cwd=root,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


class Runner(Child):
    """Child process, the corpus, and a folder in which inputs are damaged one after the other."""

    def __init__(self, scratch: Path) -> None:
        super().__init__()
        self.corpus, self._work = Corpus(scratch / "corpus"), scratch / "work"

    def damaged(self, case: Case) -> tuple[Path, str]:
        """Make a case's input and return its path and the damaged files."""
        shutil.rmtree(self._work, ignore_errors=True)
        path = self.corpus.copy(case.format, self._work)
        rng = np.random.default_rng(case.seed)
        return path, ", ".join(f"{damage(self._work, kind, rng)} ({kind})" for kind in case.damages)

    def run_case(self, case: Case) -> Reading:
        """Damage an input as a case says, and read it."""
        path, file = self.damaged(case)
        commands = commands_of(case.format)
        command = commands[case.seed % len(commands)]
        reading = self.run(command, path)
        if reading.outcome == "hang":
            reading = self.run(command, path, limit_s=SECOND_LIMIT_S)
        return replace(reading, file=file, command=command)
