import pytest

from mapper.core.doubts import Doubt, doubts_of, doubts_text, kinds_text
from mapper.core.errors import DataError

DOUBTS = (Doubt("jump", "jump of 0.3 m, 0.1 m is usual"), Doubt("disagreement", "another pose fits as well"))


@pytest.mark.parametrize("doubts", [(), DOUBTS[:1], DOUBTS])
def test_doubts_are_read_from_their_texts_and_kinds(doubts):
    assert doubts_of(doubts_text(doubts), kinds_text(doubts)) == doubts


@pytest.mark.parametrize("kinds", ["", "one side; another pose"])
def test_kinds_of_older_runs_are_disagreement(kinds):
    assert doubts_of(doubts_text(DOUBTS), kinds) == tuple(
        Doubt("disagreement", doubt.text) for doubt in DOUBTS
    )


def test_a_kind_that_is_missing_is_an_error():
    with pytest.raises(ValueError, match="zip"):
        doubts_of(doubts_text(DOUBTS), "jump")


@pytest.mark.parametrize("words", [("jump; turn", "far"), ("jump", "far; or farther")])
def test_what_separates_doubts_in_files_is_in_none(words):
    with pytest.raises(DataError, match="separates doubts"):
        Doubt(*words)
