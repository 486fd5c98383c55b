"""Verdict on a run by its warnings."""

import numpy as np
import pytest

from mapper.run.manifest import RunWarning
from mapper.run.timeline import TimeLine
from mapper.run.verdict import find_warnings, verdict_of
from tests.support.run_results import MANIFEST, doubted, lost, results_of

NOTE = RunWarning(kind="gap", sentence="a gap")
DOUBT = RunWarning(
    kind="loops",
    sentence="loops are far off",
    suggestion="mapper loops RUN",
    where="1 … 2 s",
    weight="doubt",
)
BREAK = RunWarning(kind="lost", sentence="frames were lost", weight="break")


@pytest.mark.parametrize(
    ("warnings", "state"),
    [
        ([], "trusted"),
        ([NOTE, NOTE], "trusted"),
        ([NOTE, DOUBT], "doubtful"),
        ([DOUBT, BREAK], "broken in parts"),
    ],
)
def test_the_heaviest_warning_decides(warnings, state):
    assert verdict_of(warnings).state == state


def test_sentences_say_where_and_what_to_try():
    verdict = verdict_of([BREAK, DOUBT, NOTE])
    assert verdict.sentences == (
        "frames were lost",
        "loops are far off (at 1 … 2 s); try: mapper loops RUN",
    )


def test_what_was_assumed_when_the_log_was_opened_is_named_as_a_cause():
    assumed = RunWarning(kind="log", sentence="30 frames a second assumed (source.rate_hz)")
    assert any(assumed.sentence in sentence for sentence in verdict_of([assumed, DOUBT]).sentences)
    assert verdict_of([assumed, NOTE]).sentences == ()


def test_of_results():
    assert verdict_of(find_warnings(results_of(), MANIFEST)).state == "trusted"
    some = results_of(changed={k: doubted() for k in (31, 77, 132)})
    assert verdict_of(find_warnings(some, MANIFEST)).state == "trusted"
    many = results_of(changed={k: doubted() for k in range(31, 43)})
    assert verdict_of(find_warnings(many, MANIFEST)).state == "doubtful"
    gone = results_of(changed={k: lost() for k in range(100, 140)})
    assert verdict_of(find_warnings(gone, MANIFEST)).state == "broken in parts"


def test_a_place_is_told_in_seconds_of_the_log_once_if_both_ends_round_to_one():
    line = TimeLine(5_000_000_000 + np.array([0, 40, 1_020, 2_000], np.int64) * 1_000_000, 4e7, ())
    assert line.place(0, 3) == "0.0 … 2.0 s"
    assert line.place(2, 2) == "1.0 s"
    assert line.place(0, 1) == "0.0 s"
