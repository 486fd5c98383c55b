"""Page of a merged map: its voxels once, a path of each run, and the loops between runs."""

import json
import re

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.graph.g2o import write_g2o
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure, write_closures
from mapper.merging.map_page import write_merged_map_page
from mapper.merging.world_poses import Placed
from mapper.run import files
from tests.support.chromium import CHROMIUM, MISSING
from tests.support.map_page import MapPage
from tests.support.merged_runs import make_run, merged_map_of
from tests.support.octree_maps import mapped


@pytest.fixture(scope="module")
def merged(tmp_path_factory):
    """Two runs, the second one displaced, and a joint graph of a node each with a loop that was refused."""
    folder = tmp_path_factory.mktemp("runs")
    runs = [make_run(folder / f"run{i}", mapped(i), log=f"{i}") for i in range(2)]
    T_map_world = (np.eye(4), exp(np.zeros(3), np.array([0.5, 0.0, 0.0])))
    placed = [Placed(run, T, "by hand") for run, T in zip(runs, T_map_world, strict=True)]
    found = merged_map_of(placed, tmp_path_factory.mktemp("merged") / "town").map
    graph = PoseGraph({0: np.eye(4), 9: T_map_world[1]}, {0: 1, 9: 2})
    write_g2o(found.file(files.GRAPH), graph)
    loop = LoopClosure(0, 9, 1, 2, "places", "rejected", reason="isvd: too few")
    write_closures(found.file(files.LOOPS), [loop])
    return found


@pytest.fixture(scope="module")
def page(merged, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "town.html"
    write_merged_map_page(path, merged, ["a", "b"])
    return path


def element(page, name):
    found = re.search(rf'<script type="application/json" id="{name}">(.*?)</script>', page.read_text())
    return json.loads(found[1])


def test_the_page_holds_the_voxels_once_and_each_runs_path_in_the_map(merged, page):
    whole, *of_runs = element(page, "maps")["maps"]
    occupied = len(merged.octree.occupied())
    assert whole["voxels"]["count"] == whole["cloud"]["count"] == occupied
    assert [one["voxels"]["count"] for one in of_runs] == [0, 0]
    curves = element(page, "data")
    assert [one["name"] for one in curves] == ["town", "a", "b"]
    for run, drawn in zip(merged.manifest.runs, curves[1:], strict=True):
        positions = np.column_stack([drawn["path"][axis] for axis in "xyz"])
        np.testing.assert_allclose(positions, merged.trajectory(run).positions_world, atol=6e-4)
    (loop,) = curves[0]["loops"]
    assert (loop["ends"], loop["verdict"]) == ([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], "rejected")


def test_a_map_without_a_slice_has_a_page_without_a_picture(merged, page, tmp_path):
    summary = merged.file(files.SUMMARY)
    drawn = summary.rename(tmp_path / "summary.png")
    try:
        write_merged_map_page(tmp_path / "town.html", merged, ["a", "b"])
    finally:
        drawn.rename(summary)
    assert element(tmp_path / "town.html", "maps") == element(page, "maps")
    assert 'alt="town from above' in page.read_text()
    assert 'alt="town from above' not in (tmp_path / "town.html").read_text()


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_the_browser_shows_map_paths_and_why_a_loop_was_refused(page):
    with MapPage(page, height_px=800) as browser:
        assert browser.run("document.querySelector('[data-map=coloring]').value") == "height"
        assert (browser.picture().max(axis=2) > 60).mean() > 0.03
        browser.click("[data-map-layer=rejected]")
        browser.click("[data-map=above]")
        browser.sought("hint", "refused: isvd: too few")
        browser.run("document.querySelector('[data-map=cut]').value = 0")
        browser.click("[data-map-run='0']")
        assert 0.0 < (browser.picture().max(axis=2) > 60).mean() < 0.03
        assert browser.complaints == []
