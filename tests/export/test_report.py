import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from mapper.config.build import BuildConfig
from mapper.core.doubts import Doubt
from mapper.core.errors import ConfigError, DataError
from mapper.evaluators.metrics.agreement import CommonViews
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.evaluators.pictures.run_report import report
from mapper.export.report.data import Figure, chapter_of, drawn
from mapper.export.report.page import page_of, write_report
from mapper.pipeline.build import build
from mapper.run.folder import open_run
from mapper.sources import open_source
from tests.support.chromium import AXE, CHROMIUM, MISSING, NO_AXE, Page
from tests.support.command_line import invoke
from tests.support.loop_closures import loop


def some_loops(chapter):
    first, second, *_, last = chapter.results.graph.T_world_node
    return [loop(first, last), loop(second, last)]


HOSTILE = "</script><img src=x onerror=alert(1)>&\"'"
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


class Structure(HTMLParser):
    """Which elements are open, and where a page would fetch something from."""

    EMPTY = frozenset({"meta", "img", "input", "br"})

    def __init__(self, page):
        super().__init__()
        self.open, self.addresses, self.scripts = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        if tag not in self.EMPTY:
            self.open.append(tag)
        self.scripts += [dict(attributes)] if tag == "script" else []
        self.addresses += [value for name, value in attributes if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def runs(desk_run, desk_log, tmp_path_factory):
    config = BuildConfig.model_validate({"odometry": {"kind": "isvd"}})
    return [desk_run, build(open_source(desk_log), config, tmp_path_factory.mktemp("report") / "isvd")]


@pytest.fixture(scope="module")
def page(runs, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    result = invoke("report", *(run.path for run in runs), "--out", path)
    assert result.stdout == f"{path}\n"
    return path


def test_the_numbers_are_the_run_s(runs):
    run = runs[0]
    data = drawn(chapter_of(run, "desk", []))

    trajectory = run.trajectory
    np.testing.assert_allclose(data["path"]["x"], trajectory.positions_world[:, 0], atol=6e-4)
    assert data["path"]["t"][0] == 0.0
    assert data["frames"]["inliers"] == [record.diagnostics.inliers for record in run.records]
    assert [(loop["i"], loop["j"], loop["verdict"]) for loop in data["loops"]] == [
        (loop.i, loop.j, loop.verdict) for loop in run.loops
    ]


def test_agreement_of_views_is_measured_where_the_log_is(runs, page, tmp_path):
    run = runs[0]
    measured = CommonViews(run.open_log()).disagreements(run.tracked_trajectory)
    assert f"{measured.rms_m:.3g} m; 95 %: " in page.read_text(encoding="utf-8")

    manifest = run.manifest.model_copy(
        update={"input": run.manifest.input.model_copy(update={"path": str(tmp_path / "moved")})}
    )
    moved = report([replace(run, manifest=manifest)], tmp_path / "moved.html")
    assert f"{measured.rms_m:.3g} m; 95 %: " not in moved.read_text(encoding="utf-8")


def test_uncertainty_and_doubt_are_the_poses_s(runs):
    chapter = chapter_of(runs[0], "desk", [])
    path, poses = drawn(chapter)["path"], runs[0].poses
    np.testing.assert_allclose(path["band_m"], 2.0 * poses.horizontal_sigmas_m, rtol=2e-3, atol=1e-12)
    np.testing.assert_allclose(path["band_3d_m"], 2.0 * poses.position_sigmas_m, rtol=2e-3, atol=1e-12)
    assert path["band_m"][-1] > 0.0
    assert path["doubtful"] == [False] * 31
    records = list(chapter.results.records)
    records[7] = replace(records[7], outcome="doubtful", doubts=(Doubt("jump", "jump"),))
    doubted = replace(chapter, results=replace(chapter.results, records=records))
    path = drawn(doubted)["path"]
    assert [k for k, is_doubtful in enumerate(path["doubtful"]) if is_doubtful] == [7]


def test_the_errors_are_the_terms_of_the_ate(runs):
    run = runs[0]
    errors_m = np.array(drawn(chapter_of(run, "desk", []))["error"]["m"])
    ate_m = evaluate(run.trajectory, run.truth).ate_m
    assert np.sqrt((errors_m**2).mean()) == pytest.approx(ate_m, rel=1e-3)


def test_the_page_is_well_formed_and_fetches_nothing(page):
    structure = Structure(page.read_text())
    assert structure.open == []
    assert len(structure.addresses) >= 2
    assert all(address.startswith("data:image/") for address in structure.addresses)
    assert "default-src 'none'" in page.read_text()


def test_the_tables_hold_every_run_side_by_side(page, runs):
    text = page.read_text()
    assert re.search(
        r"<th>ATE RMSE, SE\(3\)-aligned</th><td[^>]*>[\d.e-]+ m</td><td[^>]*>[\d.e-]+ m</td>", text
    )
    assert '<tr class="differs"><th>odometry.kind</th>' in text
    assert "<tr><th>octree.resolution_m</th>" in text
    size = (runs[0].path / "map.bt").stat().st_size
    cells = text.partition("Map sizes")[2]
    assert f">{size / 1e3:.3g} kB, {100 * size / (runs[0].path / 'cloud.ply').stat().st_size:.3g} %" in cells
    for library, version in runs[0].manifest.libraries.items():
        assert f'<th>{library}</th><td data-of="0">{version}</td>' in text


def test_numbers_answer_questions_and_none_is_empty(page):
    numbers = page.read_text().partition('<section id="numbers">')[2].partition("</section>")[0]
    right, complete, fast = (
        part.partition("</div></div>")[0] for part in re.split(r"<h3>[^<]*\?</h3>", numbers)[1:]
    )
    assert "ATE RMSE" in right
    assert "frames tracked" in complete
    assert "frames lost" not in complete  # none was
    assert "peak memory" in fast
    more = numbers.partition("<details>")[2]
    assert "ATE median" in more
    assert not re.search(r"<tr[^>]*><th>[^<]*</th>(<td[^>]*>(–|0|0 [^<]*)</td>)+</tr>", numbers)
    for digits in re.findall(r">(?:at most )?(\d[\d.]*)[ <]", right):
        assert len(digits.replace(".", "").lstrip("0")) <= 3


def test_what_a_log_calls_itself_cannot_become_markup(runs):
    manifest = runs[0].manifest
    hostile = replace(
        runs[0],
        manifest=manifest.model_copy(
            update={"input": manifest.input.model_copy(update={"path": f"/logs/{HOSTILE.replace('/', '')}"})}
        ),
    )
    text = page_of([chapter_of(hostile, HOSTILE, [Figure(HOSTILE, HOSTILE)])])

    structure = Structure(text)
    assert structure.open == []
    assert len(structure.scripts) == 5
    assert "x" not in structure.addresses
    data = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1]
    assert json.loads(data)[0]["name"] == HOSTILE


def test_a_run_without_truth_loops_and_views_has_a_page(desk_log, tmp_path):
    source = replace(open_source(desk_log), truth=None)
    run = build(source, BuildConfig.model_validate({"loops": {"kind": "none"}}), tmp_path / "bare")
    (run.path / "cloud.png").unlink()
    data = drawn(chapter_of(run, "bare", []))
    assert (data["truth"], data["error"], data["loops"]) == (None, None, [])
    assert "no picture" in page_of([chapter_of(run, "bare", [])])


@pytest.fixture
def unmeasured(monkeypatch):
    """Spare reports the agreement of views, nearly all of their time."""

    def refuse(_log):
        raise DataError("no views")

    monkeypatch.setattr("mapper.evaluators.pictures.run_report.CommonViews", refuse)


@pytest.mark.usefixtures("unmeasured")
def test_runs_of_one_name_are_told_apart(runs, tmp_path):
    with pytest.raises(ConfigError, match="each of its own name"):
        write_report(tmp_path / "report.html", [chapter_of(runs[0], "desk", [])] * 2)
    assert list(tmp_path.iterdir()) == []

    twin = tmp_path / "desk"
    twin.symlink_to(runs[0].path)
    invoke("report", runs[0].path, twin, "--out", tmp_path / "r.html")
    assert open_run(twin).manifest == runs[0].manifest
    names = re.findall(r"checked> (\S+) <small>", (tmp_path / "r.html").read_text())
    assert names == [str(runs[0].path), str(twin)]


@pytest.mark.usefixtures("unmeasured")
def test_pages_without_a_name_are_numbered(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert [invoke("report", run.path).stdout for run in runs] == ["report.html\n", "report-2.html\n"]
    assert "desk" in (tmp_path / "report.html").read_text()
    invoke("report", runs[1].path, "--overwrite")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report-2.html", "report.html"]


def test_a_page_that_is_there_is_not_replaced_unasked(page, runs):
    again = invoke("report", runs[0].path, "--out", page)
    assert (again.exit_code, "pass --overwrite to replace it" in again.stderr) == (1, True)


@needs_browser
@pytest.mark.parametrize("width_px", [1400, 420])
def test_it_renders_without_a_complaint_and_within_the_window(page, width_px, tmp_path):
    with Page(page, width_px=width_px) as browser:
        assert browser.run("document.querySelectorAll('figure.curve path.line').length") >= 8
        assert browser.run("document.querySelectorAll('figure.plan image').length") == 2
        assert browser.run("document.documentElement.scrollWidth") <= width_px
        browser.screenshot(tmp_path / "page.png")
        assert browser.complaints == []
        assert [url for url in browser.asked_for if not url.startswith("file://")] == []


@needs_browser
def test_a_phone_shows_all_of_a_run_s_tables(runs, tmp_path):
    voxels = Figure("octree", "113024 occupied and 1437075 free voxels of 0.2 m")
    chapter = chapter_of(runs[0], "desk", [voxels])
    loops = [
        replace(each, verdict="rejected", reason="reprojection: 27 of 68 pairs agree, want 31")
        for each in some_loops(chapter)
    ]
    path = tmp_path / "report.html"
    write_report(path, [replace(chapter, results=replace(chapter.results, loops=loops))])
    cut = "[...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth > e.clientWidth).length"
    with Page(path, width_px=420) as browser:
        browser.run("document.querySelector('details').open = true")
        assert browser.run("document.querySelectorAll('.scroll').length") >= 4
        assert browser.run(cut) == 0


@needs_browser
def test_the_verdict_is_first_and_no_curve_begins_with_what_the_first_frame_lacks(page):
    with Page(page) as browser:
        titles = browser.run("[...document.querySelectorAll('h2')].map(e => e.textContent)")
        assert titles[:4] == ["Verdict", "Map", "Plans and views", "Numbers"]
        d = "document.querySelector('[data-curve={}] path.line').getAttribute('d')"
        begins = [browser.run(d.format(key)).split("L")[0] for key in ("features", "matches", "inliers")]
        left_px = [float(begin[1:].split()[0]) for begin in begins]
        assert left_px[0] < left_px[1] == left_px[2]  # the first frame has nothing to be matched with


@needs_browser
@pytest.mark.skipif(not AXE.is_file(), reason=NO_AXE)
@pytest.mark.parametrize("width_px", [1400, 420])
def test_nothing_bars_a_person_from_it(page, width_px):
    with Page(page, width_px=width_px) as browser:
        assert browser.barriers() == []


@needs_browser
def test_what_is_told_by_pointing_clicking_and_dragging(page):
    curves = "document.querySelectorAll('[data-curve=inliers] path.line').length"
    read_out = "document.querySelector('[data-curve=inliers] .read-out').textContent"
    with Page(page) as browser:
        x, y = browser.centre("[data-curve=inliers] svg")
        browser.mouse("mouseMoved", x, y)
        assert re.match(r"desk at [\d.]+ s: \d+   isvd at [\d.]+ s: \d+$", browser.run(read_out))
        assert "from the truth" in browser.run("document.querySelector('.plan .read-out').textContent")
        assert browser.run("document.querySelector('.plan .here').getAttribute('visibility')") == "visible"

        browser.click("[data-curve=inliers] .legend button")
        assert browser.run(curves) == 1
        browser.click("[data-curve=inliers] .legend button")
        browser.click("[data-run='1']")
        assert browser.run(curves) == 1
        assert browser.run("[...document.querySelectorAll('[data-of=\"1\"]')].every(e => e.hidden)")
        browser.click("[data-run='1']")

        labels = "[...document.querySelectorAll('[data-curve=inliers] text')].map(e => e.textContent)"
        before = browser.run(labels)
        x, y = browser.centre("[data-curve=inliers] svg")
        browser.mouse("mousePressed", x, y, clicks=1)
        browser.mouse("mouseMoved", x + 200, y)
        browser.mouse("mouseReleased", x + 200, y, clicks=1)
        assert browser.run(labels) != before
        browser.run(
            "document.querySelector('[data-curve=inliers] svg').dispatchEvent(new MouseEvent('dblclick'))"
        )
        assert browser.run(labels) == before

        bar = "document.querySelector('.plan svg text').textContent"
        everything = browser.run(bar)
        x, y = browser.centre(".plan svg")
        browser.mouse("mousePressed", x, y, clicks=1)
        browser.mouse("mouseMoved", x + 40, y + 40)
        browser.mouse("mouseReleased", x + 40, y + 40, clicks=1)
        assert float(browser.run(bar).split()[0]) < float(everything.split()[0])
        browser.run("document.querySelector('.plan svg').dispatchEvent(new MouseEvent('dblclick'))")
        assert browser.run(bar) == everything

        shown = "[...document.querySelectorAll('.settings tbody tr')].filter(e => !e.hidden).length"
        differing, everything = browser.run(shown), "document.querySelectorAll('.settings tbody tr').length"
        assert 0 < differing < browser.run(everything)
        browser.click("#differing")
        assert browser.run(shown) == browser.run(everything)
        browser.run(
            "(() => { const e = document.getElementById('setting'); e.value = 'octree.';"
            " e.dispatchEvent(new Event('input')); })()"
        )
        assert 0 < browser.run(shown) < browser.run(everything)
        assert browser.complaints == []


@needs_browser
def test_the_loops_table_sorts_and_sifts(runs, tmp_path):
    chapter = chapter_of(runs[0], "desk", [])
    rejected = [
        replace(each, verdict="rejected", reason="isvd: too few", i=k)
        for k, each in enumerate(chapter.results.loops[:3] or some_loops(chapter))
    ]
    path = tmp_path / "report.html"
    write_report(
        path, [replace(chapter, results=replace(chapter.results, loops=(*rejected, *some_loops(chapter))))]
    )
    first = "[...document.querySelectorAll('.loops tbody tr')].map(e => Number(e.firstChild.textContent))"
    with Page(path) as browser:
        nodes = browser.run(first)
        browser.click(".loops th")
        assert browser.run(first) == sorted(nodes)
        browser.click(".loops th")
        assert browser.run(first) == sorted(nodes, reverse=True)
        browser.run(
            "(() => { const e = document.querySelector('.loops select'); e.value = 'accepted';"
            " e.dispatchEvent(new Event('change')); })()"
        )
        assert len(browser.run(first)) == 2
