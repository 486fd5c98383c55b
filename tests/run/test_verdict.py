"""Verdict on a run by its warnings."""

import pytest

from mapper.run.manifest import RunWarning, Trial
from mapper.run.verdict import verdict_of
from mapper.run.warnings import find_warnings
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


def test_what_helped_in_a_trial_is_the_suggestion():
    trial = Trial(where="3.0 … 4.3 s", frames=40, unplaced=20, tried={"a=1": 12, "odometry.search_px=30": 2})
    first, second = verdict_of([BREAK, DOUBT], trial).sentences
    assert first == (
        "frames were lost; try: --set odometry.search_px=30 (of 40 frames at 3.0 … 4.3 s, 2 were lost or "
        "doubtful with it, 20 without)"
    )
    assert second.endswith("try: mapper loops RUN")


@pytest.mark.parametrize(
    ("unplaced", "tried", "text"),
    [
        (20, {"a=1": 12, "b=2": 11}, "nothing tried helped (a=1, b=2)"),
        (0, {"a=1": 0}, "nothing tried helped (a=1)"),
        (1, {"a=1": 1}, "nothing tried helped (a=1)"),
        (20, {}, "nothing tried helped (no other setting applies)"),
    ],
)
def test_where_nothing_helped_that_is_said(unplaced, tried, text):
    assert Trial(where="", frames=40, unplaced=unplaced, tried=tried).text == text


def test_of_results():
    assert verdict_of(find_warnings(results_of(), MANIFEST)).state == "trusted"
    some = results_of(changed={k: doubted() for k in (31, 77, 132)})
    assert verdict_of(find_warnings(some, MANIFEST)).state == "trusted"
    many = results_of(changed={k: doubted() for k in range(31, 39)})
    assert verdict_of(find_warnings(many, MANIFEST)).state == "doubtful"
    gone = results_of(changed={k: lost() for k in range(100, 140)})
    assert verdict_of(find_warnings(gone, MANIFEST)).state == "broken in parts"
