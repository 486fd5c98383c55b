"""Damaged inputs of every format are read or refused with one line: no traceback, no death, no hang."""

import hypothesis
import pytest

from tests.fuzz.corpus import FORMATS, commands_of
from tests.fuzz.runner import Runner, cases

CASES = 300


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    with Runner(tmp_path_factory.mktemp("fuzz")) as runner:
        yield runner


def test_undamaged_inputs_are_read(runner, tmp_path):
    for name in FORMATS:
        path = runner.corpus.copy(name, tmp_path / name)
        for command in commands_of(name):
            reading = runner.run(command, path)
            assert reading.outcome in ("read", "noted"), (name, command, reading)


@hypothesis.given(case=cases())
@hypothesis.settings(max_examples=CASES, derandomize=True)
def test_damaged_inputs_are_read_or_refused(runner, case):
    reading = runner.run_case(case)
    assert not reading.is_fault, f"{reading.file}\n{reading.command}\n{reading.outcome}: {reading.detail}"
