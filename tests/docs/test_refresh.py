"""What a page shows of an output is taken anew from what is printed now."""

import importlib.util

import pytest

from tests.support.pages import OMITTED, omits_rows_of
from tests.support.paths import ROOT


@pytest.fixture(scope="module")
def abridged():
    path = ROOT / "scripts" / "refresh_outputs.py"
    spec = importlib.util.spec_from_file_location("refresh_outputs", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.abridged


PRINTED = [f"row{i}    {i}" for i in range(20)]


def test_an_output_that_is_shown_whole_is_shown_whole_again(abridged):
    assert abridged(["row0    8"], PRINTED) == PRINTED
    assert abridged([], PRINTED) == PRINTED


def test_as_many_rows_are_left_out_as_before(abridged):
    shown = abridged(["a  1", "b  2", OMITTED, "z  9"], PRINTED)

    assert shown == [PRINTED[0], PRINTED[1], OMITTED, PRINTED[19]]
    assert omits_rows_of(shown, PRINTED)
    assert abridged(shown, PRINTED) == shown


def test_rows_between_are_found_by_their_names(abridged):
    shown = abridged([OMITTED, "row7    70", OMITTED], PRINTED)

    assert shown == [OMITTED, PRINTED[7], OMITTED]
    assert omits_rows_of(shown, PRINTED)


def test_a_row_of_several_lines_stays_whole(abridged):
    printed = [PRINTED[0], "             and more", *PRINTED[1:]]

    assert abridged(["a  1", OMITTED], printed) == [*printed[:2], OMITTED]


def test_a_short_output_is_shown_whole(abridged):
    assert abridged(["a  1", OMITTED], PRINTED[:10]) == PRINTED[:10]
    assert abridged(["a  1"] * 18 + [OMITTED], PRINTED) == PRINTED
