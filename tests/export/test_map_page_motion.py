"""The map in the browser moves as a person moves it: by mouse, fingers and keys."""

import re
import time
from itertools import pairwise

import numpy as np
import pytest

from tests.support.chromium import CHROMIUM, MISSING
from tests.support.command_line import invoke
from tests.support.map_page import MapPage, change, lit

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


@pytest.fixture(scope="module")
def page(desk_run, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "desk.html"
    invoke("view", desk_run.path, "--html", "--out", path)
    return path


@needs_browser
def test_a_map_is_orbited_cut_and_coloured(page):
    with MapPage(page, height_px=800) as browser:
        assert browser.state() == "ready"
        first = browser.picture()
        assert (first.max(axis=2) > 60).mean() > 0.05  # the map is seen

        x, y = browser.centre(".map canvas")
        browser.mouse("mousePressed", x, y, clicks=1)
        for step in range(6):
            browser.call(
                "Input.dispatchMouseEvent", type="mouseMoved", x=x + 30 * step, y=y, button="left", buttons=1
            )
        browser.mouse("mouseReleased", x + 150, y, clicks=1)
        assert change(first, browser.picture()) > 0.05

        browser.click("[data-map=home]")
        assert change(first, browser.picture()) < 0.01

        browser.choose("cut", "0.5")
        assert browser.text("cut-value") == "0.50 m"
        assert browser.run("document.querySelector('[data-map=slice]').checked")
        cut = browser.picture()
        assert change(first, cut) > 0.03
        browser.click("[data-map=slice]")
        assert change(cut, browser.picture()) > 0.01

        browser.choose("coloring", "height")
        assert re.fullmatch(r"-?[\d.]+ m", browser.text("legend-low"))
        browser.choose("points", "voxels")
        browser.choose("coloring", "hits")
        assert browser.text("legend-high").endswith("scans")
        every = browser.picture()
        browser.choose("until", "0")
        assert browser.text("until-value") == "0 s"
        assert change(every, browser.picture()) > 0.01
        assert browser.complaints == []
        assert [url for url in browser.asked_for if not url.startswith("file://")] == []


@needs_browser
def test_one_frame_shows_the_points_where_the_path_is(page):
    with MapPage(page, height_px=800) as browser:
        browser.awaited(
            'import("mapper/budget").then(({ Budget }) => {'
            " Budget.prototype.learn = function () { this.share = 1; }; })"
        )
        first = browser.picture()
        for other in ("above", "home") * 2:  # from the second on each is drawn once, with all points
            browser.click(f"[data-map={other}]")
            seen = browser.picture()
            assert change(first, seen) > 0.05 if other == "above" else change(first, seen) < 0.01


@needs_browser
def test_keys_move_the_eye(page):
    with MapPage(page, height_px=800) as browser:
        pictures = [browser.picture()]
        browser.run("document.querySelector('.map canvas').focus()")
        for code in ("ArrowLeft", "Equal", "KeyW"):
            browser.key("keyDown", code)
            time.sleep(0.3)
            browser.key("keyUp", code)
            pictures.append(browser.picture())
        for before, after in pairwise(pictures):
            assert change(before, after) > 0.02


@needs_browser
def test_fingers_orbit_pinch_and_shift(page):
    with MapPage(page, height_px=800) as browser:
        browser.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        browser.click("[data-map=above]")
        first = browser.picture()
        at, spread = lit(first)
        x, y = browser.centre(".map canvas")

        steps = range(5)
        browser.touch(*[[(x - 40 - 8 * i, y), (x + 40 + 8 * i, y)] for i in steps])
        _, nearer = lit(browser.picture())
        assert (nearer > 1.2 * spread).all()

        browser.click("[data-map=above]")
        browser.touch(*[[(x - 40 + 15 * i, y), (x + 40 + 15 * i, y)] for i in steps])
        beside, as_large = lit(browser.picture())
        np.testing.assert_allclose(beside - at, [60.0, 0.0], atol=12.0)
        np.testing.assert_allclose(as_large, spread, rtol=0.1)

        browser.click("[data-map=above]")
        assert change(first, browser.picture()) < 0.01
        browser.touch(*[[(x, y - 30 * i)] for i in steps])
        assert change(first, browser.picture()) > 0.05
        assert browser.complaints == []


@needs_browser
def test_keys_fly(page):
    with MapPage(page, height_px=800) as browser:
        browser.click("[data-map=fly]")
        assert browser.run("document.querySelector('[data-map=fly]').ariaPressed") == "true"
        browser.run("document.querySelector('.map canvas').focus()")

        def flown(code):
            before = lit(browser.picture())
            browser.key("keyDown", code)
            browser.awaited(
                "new Promise(done => { let left = 8;"
                " const next = () => left-- ? requestAnimationFrame(next) : done(); next(); })"
            )
            browser.key("keyUp", code)
            after = lit(browser.picture())
            return after[0] - before[0], after[1] / before[1]

        assert (flown("KeyW")[1] > 1.02).all()  # nearer, so larger
        assert (flown("KeyS")[1] < 0.98).all()
        assert flown("KeyD")[0][0] < -5.0  # the map goes to the left of an eye that goes to the right
        assert flown("KeyA")[0][0] > 5.0
        assert flown("KeyE")[0][1] > 2.0  # and down below one that rises
        assert flown("KeyQ")[0][1] < -2.0
        assert flown("ArrowRight")[0][0] < -5.0
        still = browser.picture()
        time.sleep(0.3)
        assert change(still, browser.picture()) == 0.0
        assert browser.complaints == []


@needs_browser
def test_as_many_points_move_as_30_frames_a_second_allow(page):
    least = 15_000 / 500_000
    with MapPage(page) as browser:
        for fixed_ms, ms_of_all in ((2.0, 5.0), (5.0, 300.0), (8.0, 2000.0), (60.0, 400.0)):
            share = browser.awaited(f"""import("mapper/budget").then(({{ Budget }}) => {{
                const budget = new Budget(), cost = (share) => {fixed_ms} + {ms_of_all} * share;
                for (let i = 0; i < 60; i++) budget.learn(budget.share, cost(budget.share), 500000);
                return budget.share; }})""")
            if fixed_ms + ms_of_all < 33.0:
                assert share == 1.0
            elif fixed_ms > 33.0:
                assert share == pytest.approx(least)
            else:
                assert 20.0 < fixed_ms + ms_of_all * share < 42.0 or share == pytest.approx(least)
