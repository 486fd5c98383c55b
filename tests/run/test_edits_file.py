"""``edits.toml``: regions added and taken back with a user's own text left as it is, and mistakes refused."""

from pathlib import Path

import pytest

from mapper.core.errors import ConfigError
from mapper.mapping.config import Edits, Region
from mapper.run.edits_file import edits_text, parse_edits, with_region, without_last, write_edits

RUN = Path("runs/flat")
BOX = Region(box_m=((0.5, -1.0, 0.1), (1.2, -0.3, 1.8)))
BAND = Region(height_m=(-0.2, 2.2), path_radius_m=8.0)
POLYGON = Region(polygon_m=((1.0, 1.0), (3.0, 1.0), (3.0, 2.5)))

BY_HAND = """\
# the flat of aunt Vera

[[keep]]
height_m = [-0.2, 2.2]  # no ceiling
path_radius_m = 8
"""


def test_regions_are_added_at_the_end_and_taken_back_from_there():
    one = with_region("", RUN, "erase", BOX)
    two = with_region(one, RUN, "keepout", POLYGON)

    assert one == "[[erase]]\nbox_m = [[0.5, -1.0, 0.1], [1.2, -0.3, 1.8]]\n"
    assert parse_edits(two, RUN) == Edits(erase=(BOX,), keepout=(POLYGON,))
    assert without_last(two, RUN) == one
    assert parse_edits(without_last(one, RUN), RUN) == Edits()
    with pytest.raises(ConfigError, match="no edits to undo"):
        without_last("# nothing\n", RUN)


def test_what_a_user_wrote_stays():
    longer = with_region(BY_HAND, RUN, "keep", BOX)

    assert longer.startswith(BY_HAND)
    assert parse_edits(longer, RUN) == Edits(keep=(BAND, BOX))
    assert without_last(longer, RUN) == BY_HAND


def test_a_list_that_is_written_in_another_way_is_left_to_the_user():
    text = "erase = [{height_m = [0, 1]}]\n"
    with pytest.raises(ConfigError, match=r"edits\.toml: its regions are not listed as"):
        with_region(text, RUN, "erase", BOX)
    with pytest.raises(ConfigError, match=r"edits\.toml: its regions are not listed as"):
        without_last(text, RUN)
    assert without_last(with_region(text, RUN, "keep", BOX), RUN) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[erase]]\n", "erase.0: no condition; want one or more of box_m, height_m"),
        ("[[erase]]\nboxm = [[0,0,0],[1,1,1]]\n", "erase.0.boxm: unknown; did you mean box_m?"),
        ("[[erased]]\nheight_m = [0, 1]\n", "erased: unknown; did you mean erase?"),
        ("[[erase]]\nbox_m = [[0,0,0],[1,1]]\n", "erase.0.box_m.1: 2 values are too few"),
        ("[[erase]]\nbox_m = [[0,0,2],[1,1,1]]\n", "want the lowest corner, then the highest"),
        ("[[keep]]\nheight_m = [2, 1]\n", r"height_m = \[2.0, 1.0\]: want the lowest z"),
        ("[[keep]]\nheight_m = [nan, 1]\n", "keep.0.height_m.0: want a finite number"),
        ("[[keep]]\nheight_m = [2, 3]\nbox_m = [[0,0,0],[1,1,1]]\n", "no height in common"),
        ("[[keep]]\npath_radius_m = 0\n", "path_radius_m: want more than 0"),
        ("[[keepout]]\npolygon_m = [[0, 0], [1, 1]]\n", "want 3 or more, each once"),
        ("[[keepout]]\npolygon_m = [[0, 0], [1, 1], [2, 2]]\n", "without an area"),
        ("[[keepout]]\npolygon_m = [[0, 0], [3, 0], [0, 2], [3, 1]]\n", "cross; want the corners in order"),
        ("[[erase\n", "not valid TOML"),
    ],
)
def test_a_mistake_is_told_in_one_line(text, message):
    with pytest.raises(ConfigError, match=message) as caught:
        parse_edits(text, RUN)
    assert str(caught.value).startswith("runs/flat/edits.toml: ")
    assert "\n" not in str(caught.value).split("not valid")[0]


def test_a_file_without_text_is_no_file(tmp_path):
    assert edits_text(tmp_path) == ""
    write_edits(tmp_path, BY_HAND)
    assert edits_text(tmp_path) == BY_HAND
    write_edits(tmp_path, "\n")
    assert not (tmp_path / "edits.toml").exists()
