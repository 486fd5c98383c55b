"""Edits made on the page of a map, as a person makes them, and the file that it saves."""

from dataclasses import replace

import pytest

from mapper.config.loading import read_config
from mapper.export.report.data import chapter_of
from mapper.export.report.map_page import write_map_page
from mapper.run.edits_file import EditsFile
from tests.support.chromium import AXE, CHROMIUM, MISSING, NO_AXE
from tests.support.loop_closures import loop
from tests.support.map_page import EditedPage

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


@pytest.fixture(scope="module")
def nodes(desk_run):
    return list(desk_run.graph.T_world_node)


@pytest.fixture(scope="module")
def page(desk_run, nodes, tmp_path_factory):
    """The desk's page with a loop that holds, between the first and the last node, and one that does not."""
    chapter = chapter_of(desk_run, "desk", [])
    first, second, *_, last = nodes
    loops = [loop(first, last), loop(second, last, verdict="rejected", reason="gate: too far")]
    path = tmp_path_factory.mktemp("edited") / "desk.html"
    write_map_page(path, [replace(chapter, results=replace(chapter.results, loops=loops))])
    return path


@pytest.fixture
def browser(page):
    with EditedPage(page, height_px=800) as browser:
        browser.click("[data-map=edit] summary")
        browser.click("[data-map=above]")
        browser.picture()
        yield browser
        assert browser.complaints == []


def test_loops_are_chosen_on_the_map_and_accepted_rejected_added_and_undone(browser, nodes):
    first, second, *_, last = nodes
    x, y = browser.sought("hint", f"loop {first} – {last}")
    browser.tap(x, y)
    browser.choose("edit-i", str(first))  # a keyframe may lie before the loop
    browser.choose("edit-j", str(last))
    assert browser.text("edit-told") == "this loop holds"
    browser.click("[data-map=edit-accept]")
    assert browser.text("edit-told") == "this loop holds already"
    browser.click("[data-map=edit-reject]")
    browser.choose("edit-i", str(second))
    assert browser.text("edit-told") == "refused: gate: too far"
    browser.click("[data-map=edit-accept]")
    browser.choose("edit-i", "")
    browser.choose("edit-j", "")
    browser.tap(*browser.sought("hint", f"keyframe {first} at"))
    browser.tap(*browser.sought("hint", f"keyframe {second} at"))
    assert browser.text("edit-told") == "no candidate: accepting adds it"
    browser.click("[data-map=edit-accept]")
    assert browser.edits() == [
        f"reject {first} – {last}",
        f"accept {second} – {last}",
        f"accept {first} – {second}",
    ]
    browser.undo_by_key()
    browser.click("[data-map=edit-undo]")
    assert browser.edits() == [f"reject {first} – {last}"]


def test_regions_are_drawn_or_typed_and_saved_as_a_file_that_the_verb_takes(browser, nodes, tmp_path):
    first, *_, last = nodes
    browser.choose("edit-i", str(first))
    browser.choose("edit-j", str(last))
    browser.click("[data-map=edit-reject]")
    browser.choose("edit-j", "")
    browser.click("[data-map=edit-drop]")
    browser.click("[data-map=edit-draw]")
    x, y = browser.centre(".map canvas")
    browser.drag((x - 60, y - 40), (x + 60, y + 40))
    browser.click("[data-map=edit-add]")
    browser.choose("edit-kind", "keepout")
    browser.click("[data-map=edit-draw]")
    browser.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=1)
    for off in ((-90, -90), (90, -90), (0, 90)):
        browser.touch([(x + off[0], y + off[1])])
    browser.click("[data-map=edit-add]")
    browser.choose("edit-kind", "keep")
    browser.choose("edit-region", "1.9 -0.2")
    browser.click("[data-map=edit-region]")
    browser.key("keyDown", "Enter")
    browser.key("keyUp", "Enter")

    path = browser.saved("edit-save", tmp_path / "desk.edits.toml")
    edits = read_config(path, EditsFile)

    assert (edits.reject[0].nodes, edits.drop) == ((first, last), (first,))
    (low, high), (polygon,) = edits.erase[0].box_m, [region.polygon_m for region in edits.keepout]
    aspect = (high[0] - low[0]) / (high[1] - low[1])
    assert aspect == pytest.approx(120.0 / 80.0, rel=0.02)
    assert high[0] - low[0] == pytest.approx((polygon[1][0] - polygon[0][0]) * 120.0 / 180.0, rel=0.02)
    assert edits.keep[0].height_m == (-0.2, 1.9)


@pytest.mark.skipif(not AXE.is_file(), reason=NO_AXE)
def test_editing_bars_no_person(browser):
    browser.choose("edit-region", "0 0 0 1 1 1")
    browser.click("[data-map=edit-add]")
    assert browser.barriers() == []
