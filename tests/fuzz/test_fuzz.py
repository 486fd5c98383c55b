"""Damaged inputs and hostile command lines are taken or refused with a line: no traceback, death or hang."""

import hypothesis
import pytest

from mapper import sources
from mapper.sources import format_of
from tests.fuzz.command_lines import Sandbox, every_verb, lines
from tests.fuzz.corpus import FORMATS, commands_of
from tests.fuzz.runner import Runner, cases

CASES, LINES = 300, 60


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    with Runner(tmp_path_factory.mktemp("fuzz")) as runner:
        yield runner


def test_undamaged_inputs_are_read(runner, tmp_path):
    for name in FORMATS:
        path = runner.corpus.copy(name, tmp_path / name)
        for command in commands_of(name)[: 4 if name == "run, old" else None]:  # the rest reads as of "run"
            reading = runner.run(command, path)
            assert reading.outcome in ("read", "noted"), (name, command, reading)


def test_the_corpus_has_every_format(runner, tmp_path):
    read = {format_of(runner.corpus.copy(name, tmp_path / name)) for name in FORMATS}
    assert set(sources.FORMATS) <= read


@hypothesis.given(case=cases())
@hypothesis.settings(max_examples=CASES, derandomize=True)
def test_damaged_inputs_are_read_or_refused(runner, case):
    reading = runner.run_case(case)
    assert not reading.is_fault, f"{reading.file}\n{reading.command}\n{reading.outcome}: {reading.detail}"


@pytest.fixture(scope="module")
def sandbox(runner, tmp_path_factory):
    return Sandbox(tmp_path_factory.mktemp("lines"), runner)


@hypothesis.given(line=lines(brief=True))
@hypothesis.settings(max_examples=LINES, derandomize=True)
def test_command_lines_are_run_or_refused_and_nothing_is_lost(sandbox, line):
    reading = sandbox.run(line)
    assert not reading.is_fault, f"{reading.file}\n{reading.command}\n{reading.outcome}: {reading.detail}"


def test_lines_are_of_every_verb():
    assert {("build",), ("sensor", "depth"), ("vocabulary", "show")} <= {verb.words for verb in every_verb()}
