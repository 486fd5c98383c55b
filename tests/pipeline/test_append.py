"""A second session appended to a run: tied by loops, solved and mapped with the first."""

import json
import shutil

import numpy as np
import pytest

from mapper.cli.summary import summary_text
from mapper.config.loading import overridden
from mapper.core.errors import ConfigError, RunError
from mapper.evaluators.metrics.trajectory_errors import align, associate, ate, ate_rmse_m
from mapper.octree.map import read_octree
from mapper.odometry.keyframes.odometry import KeyframeOdometry
from mapper.pipeline.append import append
from mapper.pipeline.fuse import fuse
from mapper.run.folder import moved_log, open_run
from mapper.run.observers import Observers
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import sessions_of
from tests.support.command_line import mapper
from tests.support.files import files_of


@pytest.fixture(scope="module")
def joined(first, desk_log):
    """The second half, appended by the command line."""
    out = first.path.with_name("joined")
    mapper("build", desk_log, "--first", 16, "--onto", first.path, "--out", out)
    return open_run(out)


class Counting(Observers):
    """Notes what it receives."""

    def __init__(self):
        self.seen = []

    def on_frame(self, *_):
        self.seen.append("frame")

    def on_mapped(self, *_):
        self.seen.append("maps")


def test_both_sessions_are_one_run_in_the_first_one_s_world(first, joined):
    counts = joined.manifest.counts
    assert counts.listed == counts.tracked == len(joined.trajectory) == 31
    assert [record.stamp_ns for record in joined.records] == joined.trajectory.stamps_ns.tolist()
    assert joined.manifest.levelling == first.manifest.levelling

    T_first, T_joined = (run.graph.T_world_node for run in (first, joined))
    assert list(T_joined)[: len(T_first)] == list(T_first)
    np.testing.assert_allclose(T_joined[0], T_first[0], atol=1e-9)

    assert ate_rmse_m(joined.trajectory, joined.truth) < 0.02


def test_edits_by_hand_hold_in_the_joined_map(first, joined, desk_log, tmp_path):
    edited = shutil.copytree(first.path, tmp_path / "edited")
    (edited / "edits.toml").write_text("[[keep]]\nheight_m = [-1.0, 0.9]  # no ceiling\n")

    mapper("build", desk_log, "--first", 16, "--onto", edited, "--out", tmp_path / "both", "--quiet")

    both = open_run(tmp_path / "both")
    assert (both.path / "edits.toml").read_text() == (edited / "edits.toml").read_text()
    (edit,) = both.manifest.edits
    assert edit.count == both.manifest.counts.leaves < joined.manifest.counts.leaves
    assert read_octree(both.file("map.ot")).leaves().centres_world[:, 2].max() < 0.9
    assert read_octree(joined.file("map.ot")).leaves().centres_world[:, 2].max() > 0.9


def test_loops_between_the_sessions_hold(first, joined):
    known = first.graph.T_world_node.keys()
    loops = joined.loops
    assert [(loop.i, loop.j) for loop in loops[: len(first.loops)]] == [
        (loop.i, loop.j) for loop in first.loops
    ]
    assert any(loop.verdict == "accepted" and loop.i in known and loop.j not in known for loop in loops)
    held = [(loop.i, loop.j) for loop in loops if loop.verdict == "accepted"]
    factors = joined.graph.factors
    assert [(f.i, f.j) for f in factors[len(factors) - len(held) :]] == held
    assert {f.origin for f in factors[: len(factors) - len(held)]} == {"odometry"}


def test_every_frame_hangs_on_its_node(joined):
    graph = joined.graph
    T_by_stamp = dict(zip(joined.trajectory.stamps_ns.tolist(), joined.trajectory.T_world_body, strict=True))
    for record in joined.records:
        if record.is_keyframe:
            np.testing.assert_allclose(
                T_by_stamp[record.stamp_ns], graph.T_world_node[record.node], atol=1e-9
            )
    assert {record.node for record in joined.records} == set(graph.T_world_node)


def test_the_manifest_remembers_both_logs(joined, desk_log):
    manifest = json.loads((joined.path / "manifest.json").read_text())
    (second,) = manifest["input"]["appended"]
    assert second["path"] == manifest["input"]["path"] == str(desk_log)
    assert (second["source"]["first_frame"], second["shift_ns"]) == (16, 0)
    assert joined.config.source.last_frame == 15
    source = joined.open_log()
    assert [entry.stamp_ns for entry in source.entries()] == [
        entry.stamp_ns for entry in open_source(desk_log).entries()
    ]


def test_the_table_names_both_logs(first, joined):
    assert summary_text(joined, []).splitlines()[0].split() == ["logs", "desk", "+", "desk"]
    assert summary_text(first, []).startswith("frames")


def test_the_maps_are_those_of_fusing_from_scratch(joined, tmp_path):
    again = shutil.copytree(joined.path, tmp_path / "again")
    (again / "scan_updates.bin").unlink()
    mapper("fuse", again, "--quiet")
    for name in ("map.ot", "cloud.ply", "slice.pgm"):
        assert (again / name).read_bytes() == (joined.path / name).read_bytes()


def test_moved_logs_are_told_in_their_order(joined, desk_log, tmp_path):
    run = open_run(shutil.copytree(joined.path, tmp_path / "run"))
    moved = shutil.copytree(desk_log, tmp_path / "moved")
    mapper("fuse", run.path, "--log", moved, "--log", desk_log, "--set", "cloud.voxel_m=0.1", "--quiet")
    known = open_run(run.path).manifest.input
    assert [known.path, known.appended[0].path] == [str(moved), str(desk_log)]
    result = mapper("fuse", run.path, "--log", moved, status=1)
    assert "made from 2 logs" in result.stderr
    with pytest.raises(RunError, match="1 given, want all of them in this order"):
        moved_log(run, moved)


def test_loops_can_be_edited_afterwards(first, joined, tmp_path):
    run = shutil.copytree(joined.path, tmp_path / "run")
    known = first.graph.T_world_node.keys()
    between = [
        (loop.i, loop.j)
        for loop in joined.loops
        if loop.verdict == "accepted" and loop.i in known and loop.j not in known
    ]
    mapper("loops", run, "--remove", *between[0], "--quiet")
    before = files_of(run)
    pairs = [word for pair in between[1:] for word in ("--remove", *pair)]
    result = mapper("loops", run, *pairs, status=1)
    assert "the graph falls apart" in result.stderr
    assert files_of(run) == before


def test_a_third_session_is_appended_to_two(joined, desk_log, tmp_path):
    """The same walk once more: its stamps are taken already, so they are shifted."""
    source = open_source(desk_log, SourceConfig(last_frame=12))
    config, observer = overridden(joined.config, ["source.last_frame=12"]), Counting()
    three = append(source, joined, config, tmp_path / "three", observer=observer)
    assert observer.seen == [*["frame"] * 13, "maps"]
    assert three.manifest.counts.tracked == 31 + 13
    assert [len(session.log) for session in sessions_of(three.open_log())] == [16, 15, 13]
    assert three.manifest.input.appended[1].shift_ns > 0
    matched = associate(three.trajectory, three.truth)
    assert len(matched) == 44
    assert ate(align(matched, "se3").moved(matched)).rmse < 0.02
    assert three.manifest.timing.log_s == pytest.approx(31 / 15 + 11 / 15, abs=0.2)
    fuse(three.open_log(), three, three.config)


def test_what_contradicts_the_camera_is_warned_of(first, desk_log, tmp_path, monkeypatch):
    for check in ("calibration_warnings", "sensor_notes"):
        monkeypatch.setattr(KeyframeOdometry, check, lambda _: ["wrong"])
    config = overridden(first.config, ["source.first_frame=16", "source.last_frame=30"])

    run = append(open_source(desk_log, config.source), first, config, tmp_path / "out")

    assert {"camera", "shutter"} <= {warning.kind for warning in run.manifest.warnings}


def test_another_place_is_refused_and_the_run_is_untouched(first, elsewhere, tmp_path):
    before = files_of(first.path)
    result = mapper("build", elsewhere, "--onto", first.path, "--out", tmp_path / "out", "--quiet", status=1)
    assert f"mapper: {elsewhere}: no loop connects it to {first.path}" in result.stderr
    assert "is it the same place?" in result.stderr
    assert result.stderr.count("\n") == 1
    assert files_of(first.path) == before
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("odometry.max_keyframe_gap=9", "odometry: fixed by"),
        ("level.frames=3", "level: fixed by"),
        ("graph.solve=proportional", "graph.solve=proportional: cannot join"),
        ("loops.propose=nearby", "recognised by visual words alone"),
        ("loops.kind=none", "loops.kind=none: cannot connect two sessions; want places"),
    ],
)
def test_settings_that_cannot_join_are_refused(first, desk_log, tmp_path, override, message):
    config = overridden(first.config, [override, "source.first_frame=16", "source.last_frame=30"])
    with pytest.raises(ConfigError, match=message):
        append(open_source(desk_log, config.source), first, config, tmp_path / "out")


def test_a_configuration_file_and_a_run_to_append_to_exclude_each_other(first, desk_log, tmp_path):
    out = tmp_path / "out"
    config = first.path / "config.json"
    result = mapper("build", desk_log, "--onto", first.path, "--config", config, "--out", out, status=1)
    assert "has no meaning with --onto; give single settings by --set" in result.stderr
