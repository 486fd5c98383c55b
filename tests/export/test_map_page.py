import base64
import json
import re
import zlib
from dataclasses import replace

import cv2
import numpy as np
import open3d as o3d
import pytest

from mapper.core.errors import ConfigError
from mapper.export.report import map_data
from mapper.export.report.data import chapter_of
from mapper.export.report.map_data import map_of
from mapper.export.report.map_page import write_map_page
from mapper.export.report.packing import pack_layers, pack_points
from mapper.octree.keys import codes_of
from mapper.octree.map import read_octree
from mapper.octree.scan_updates import open_scan_updates
from tests.support.chromium import AXE, CHROMIUM, MISSING, NO_AXE
from tests.support.command_line import invoke
from tests.support.loop_closures import loop
from tests.support.map_page import MapPage, change, lit

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


def unpacked(packed, planes):
    """Read points back as the page does: positions, then planes of 2 or 1 bytes."""
    data, count, at = zlib.decompress(base64.b64decode(packed["data"])), packed["count"], 0
    read = []
    for size in (2, 2, 2, *planes):
        low = np.frombuffer(data, np.uint8, count, at).astype(np.int64)
        steps = low
        if size == 2:
            zigzag = low | np.frombuffer(data, np.uint8, count, at + count).astype(np.int64) << 8
            steps = (zigzag >> 1) ^ -(zigzag & 1)
        read.append(np.cumsum(steps) % (1 << 8 * size))
        at += size * count
    assert at == len(data)
    return np.array(packed["low"]) + packed["step"] * np.column_stack(read[:3]), read[3:]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("span_m", [0.5, 40.0, 3000.0])
def test_points_come_back_to_half_a_step_with_their_values(seed, span_m):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-span_m, span_m, (4000, 3))
    ids, bytes_ = np.arange(4000, dtype=np.uint16), rng.integers(0, 256, 4000).astype(np.uint8)
    packed = pack_points(points, [ids, bytes_], step_m=0.001, most=10_000)
    back, (order, values) = unpacked(packed, (2, 1))
    assert packed["step"] >= 0.001
    np.testing.assert_allclose(back, points[order], atol=0.501 * packed["step"])
    np.testing.assert_array_equal(values, bytes_[order])
    assert sorted(order.tolist()) == list(range(4000))


def test_of_too_many_points_evenly_spread_ones_are_kept():
    points = np.random.default_rng(0).uniform(0.0, 1.0, (8000, 3))
    packed = pack_points(points, [], step_m=1e-4, most=1000)
    kept, _ = unpacked(packed, ())
    assert (packed["count"], packed["of"]) == (1000, 8000)
    in_octants = np.bincount((kept > 0.5) @ [1, 2, 4], minlength=8)
    assert in_octants.min() > 90


def test_no_points_are_packed_too():
    assert pack_points(np.empty((0, 3)), [], step_m=0.1, most=5)["count"] == 0


def test_layers_come_back_one_by_one():
    layers = np.random.default_rng(1).integers(0, 3, (4, 5, 7)).astype(np.uint8)
    packed = pack_layers(layers)
    data, begin = base64.b64decode(packed["data"]), 0
    for layer, end in zip(layers, packed["ends"], strict=True):
        quarters = np.frombuffer(zlib.decompress(data[begin:end]), np.uint8)
        cells = (quarters[:, np.newaxis] >> [0, 2, 4, 6] & 3).reshape(-1)[:35].reshape(5, 7)
        np.testing.assert_array_equal(cells, layer)
        begin = end


@pytest.fixture(scope="module")
def shown(desk_run):
    return map_of(chapter_of(desk_run, "desk", []))


def test_voxels_are_the_octree_s_with_their_hits(desk_run, shown):
    centres, (first, octaves) = unpacked(shown["voxels"], (2, 1))
    octree = read_octree(desk_run.path / "map.octree")
    expected = octree.occupied()
    order = np.lexsort(np.rint(centres.T / 1e-3))
    expected = expected[np.lexsort(np.rint(expected.T / 1e-3))]
    np.testing.assert_allclose(centres[order], expected, atol=1e-6)

    hits = np.zeros(len(centres), int)
    codes = codes_of(centres, octree.resolution_m)
    with open_scan_updates(desk_run.scan_updates()) as updates:
        for entry in updates.entries():
            update = entry.update()
            block, bit = np.nonzero(np.unpackbits(update.occupied, axis=1, bitorder="little"))
            hits += np.isin(codes, update.codes[block] * 512 + bit)
    np.testing.assert_array_equal(octaves, np.rint(16 * np.log2(hits + 1.0)))
    assert (first[hits == 0] == 1023).all()
    assert (first[hits > 0] <= 1022).all()
    assert first[hits > 0].min() == 0


def test_the_cloud_has_the_run_s_points_and_colours(desk_run, shown):
    points, (first, _, red, _, _) = unpacked(shown["cloud"], (2, 1, 1, 1, 1))
    assert len(points) == desk_run.manifest.counts.cloud_points
    assert shown["cloud"]["has_colors"]
    assert (red % 4 == 0).all()
    assert (first <= 1022).mean() > 0.5


def test_keyframes_have_numbers_and_images(desk_run, shown):
    keyframes = [record for record in desk_run.records if record.is_keyframe]
    frames = [frame for frame in shown["frames"] if frame["node"] is not None]
    assert [(f["node"], f["inliers"]) for f in frames] == [(r.node, r.diagnostics.inliers) for r in keyframes]
    assert frames[0]["image"] == 0
    assert all(image.startswith("data:image/jpeg;base64,/9j/") for image in shown["images"])


def test_a_run_without_scan_updates_has_a_map(desk_run, monkeypatch):
    monkeypatch.setattr(type(desk_run), "scan_updates", lambda _: None)
    bare = map_of(chapter_of(desk_run, "desk", []))
    assert not bare["is_observed"]
    points, _ = unpacked(bare["cloud"], (1, 1, 1))
    assert len(points) == desk_run.manifest.counts.cloud_points


def test_limits_coarsen_voxels_layers_and_cloud(desk_run, shown, monkeypatch):
    chapter = chapter_of(desk_run, "desk", [])
    few = map_of(chapter, most_points=2000)
    assert few["voxels"]["count"] <= 1000
    assert few["voxels"]["edge_m"] > shown["voxels"]["edge_m"]
    assert few["cloud"]["count"] + few["voxels"]["count"] == 2000

    monkeypatch.setattr(map_data, "_MOST_LAYER_BYTES", 2000)
    assert map_of(chapter)["layers"]["edge_m"] > shown["layers"]["edge_m"]
    room = len(json.dumps(map_of(chapter))) - 50_000
    monkeypatch.setattr(map_data, "_MOST_BYTES", room)
    assert len(json.dumps(map_of(chapter))) < room + 2000


@pytest.fixture(scope="module")
def page(desk_run, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "desk.html"
    assert invoke("view", desk_run.path, "--html", "--out", path).stdout == f"{path}\n"
    return path


def test_the_page_fetches_nothing_and_is_the_same_each_time(page, desk_run, tmp_path):
    text = page.read_text()
    assert "default-src 'none'" in text
    assert all(address.startswith("data:image/") for address in re.findall(r'(?:src|href)="([^"]*)"', text))
    again = tmp_path / "again.html"
    write_map_page(again, [chapter_of(desk_run, desk_run.path.name, [])])
    assert again.read_bytes() == page.read_bytes()


def test_options_that_do_not_go_together_are_refused(page, desk_run, tmp_path):
    for arguments, said in (
        (("--html", "--spawn"), "choose one"),
        (("--out", tmp_path / "x.html"), "has no meaning without --html"),
        (("--html", "--out", page), "pass --overwrite"),
        ((desk_run.path,), "--html shows several"),
    ):
        result = invoke("view", desk_run.path, *arguments)
        assert (result.exit_code, said in result.stderr) == (1, True)
    chapter = chapter_of(desk_run, "desk", [])
    with pytest.raises(ConfigError, match="each of its own name"):
        write_map_page(tmp_path / "x.html", [chapter, chapter])
    assert list(tmp_path.iterdir()) == []


@needs_browser
def test_a_keyframe_tells_its_numbers_and_two_clicks_a_distance(page):
    with MapPage(page, height_px=800) as browser:
        browser.click("[data-map=above]")
        browser.picture()
        browser.tap(*browser.sought("hint", "keyframe"))
        assert re.match(r"keyframe \d+ at [\d.]+ s", browser.text("frame-title"))
        assert "features" in browser.run("document.querySelector('[data-map=frame-numbers]').textContent")
        assert browser.run("document.querySelector('[data-map=frame-image]').naturalWidth") > 100
        browser.click("[data-map=frame-close]")
        assert browser.text("frame-title") is None

        browser.click("[data-map=measure]")
        assert "click on two points" in browser.text("distance")
        lit = np.argwhere(browser.picture().max(axis=2) > 60)
        left, top, _, _ = browser.box()
        for row, column in (lit[len(lit) // 4], lit[3 * len(lit) // 4]):
            browser.tap(float(left + column), float(top + row))
        distance, level, up = map(
            float,
            re.fullmatch(r"([\d.]+) m; level ([\d.]+) m, up (-?[\d.]+) m", browser.text("distance")).groups(),
        )
        assert distance == pytest.approx(np.hypot(level, up), abs=2e-3)
        assert distance > 0.05
        assert browser.complaints == []


@needs_browser
@pytest.mark.skipif(not AXE.is_file(), reason=NO_AXE)
@pytest.mark.parametrize("width_px", [1400, 420])
def test_nothing_bars_a_person_from_the_page(page, width_px):
    with MapPage(page, width_px=width_px, height_px=800) as browser:
        browser.click("[data-map=measure]")
        assert browser.barriers() == []


@needs_browser
def test_two_runs_lie_over_each_other_or_side_by_side_and_loops_tell_their_reason(desk_run, tmp_path):
    chapter = chapter_of(desk_run, "a", [])
    first, *_, last = chapter.results.graph.T_world_node
    refused = loop(first, last, verdict="rejected", reason="isvd: too few")
    path = tmp_path / "two.html"
    results = replace(chapter.results, loops=[refused])
    write_map_page(path, [replace(chapter, results=results), replace(chapter, name="b", results=results)])
    with MapPage(path, height_px=800) as browser:
        over = browser.picture()
        browser.click("input[value=beside]")
        beside = browser.picture()
        assert change(over, beside) > 0.05
        half = beside.shape[1] // 2
        assert (beside[:, :half].max(axis=2) > 60).mean() > 0.03
        assert (beside[:, half:].max(axis=2) > 60).mean() > 0.03
        browser.click("input[value=over]")
        browser.click("[data-map-layer=keyframes]")
        browser.click("[data-map-layer=rejected]")
        browser.click("[data-map=above]")
        browser.sought("hint", "refused: isvd: too few")
        browser.click("[data-map-run='0']")
        browser.click("[data-map-run='1']")
        assert (browser.picture().max(axis=2) > 60).mean() < 0.01
        assert browser.complaints == []


@needs_browser
def test_runs_of_different_logs_stand_side_by_side_each_as_large_as_its_pane(desk_run, tmp_path):
    one = chapter_of(desk_run, "one", [])
    log = desk_run.manifest.input.model_copy(update={"fingerprint": "sha256:another"})
    other = replace(desk_run, manifest=desk_run.manifest.model_copy(update={"input": log}))
    write_map_page(tmp_path / "two.html", [one, chapter_of(other, "other", [])])
    with MapPage(tmp_path / "two.html", height_px=800) as browser:
        assert browser.run("document.querySelector('input[value=beside]').checked")
        seen = browser.picture()
        half = seen.shape[1] // 2
        (left, spread), (right, as_large) = lit(seen[:, :half]), lit(seen[:, -half:])
        np.testing.assert_allclose(left, right, atol=4.0)
        np.testing.assert_allclose(spread, as_large, rtol=0.05)
        assert spread[0] > 0.12 * half
        assert browser.complaints == []


@needs_browser
def test_the_address_keeps_the_view_and_picture_and_points_are_saved(page, shown, tmp_path):
    with MapPage(page, height_px=800) as browser:
        browser.click("[data-map=above]")
        above = browser.picture()
        assert re.fullmatch(r"[125]0* (cm|m)", browser.text("scale-text"))
        address = browser.run("location.href")
        picture = cv2.imread(str(browser.saved("save-picture", tmp_path / "desk.png")))
        assert np.abs(np.subtract(picture.shape, above.shape)).max() <= 1
        inner = slice(60, -120)  # overlays are at the edges
        assert change(above[: len(picture)][inner], picture[: len(above)][inner].astype(int)) < 0.01
        cloud = o3d.io.read_point_cloud(str(browser.saved("save-points", tmp_path / "desk.ply")))
        assert len(cloud.points) == shown["cloud"]["count"]
        browser.click("[data-map=shading]")
        assert change(above, browser.picture()) > 0.002  # edges are thin from above
    with MapPage(address, height_px=800) as browser:
        assert change(above, browser.picture()) < 0.01


@needs_browser
def test_without_webgl_there_are_pictures(page, tmp_path):
    text = page.read_text().replace("getContext(%22webgl2%22)", "getContext(%22none%22)")
    blind = tmp_path / "blind.html"
    blind.write_text(text.replace('getContext(\\"webgl2\\")', 'getContext(\\"none\\")'))
    with MapPage(blind, width_px=420) as browser:
        assert browser.state() == "pictures"
        assert browser.run("document.querySelector('.map-pictures img').checkVisibility()")
        assert browser.run("document.documentElement.scrollWidth") <= 420
