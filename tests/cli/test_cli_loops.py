"""Loops listed, added and removed by hand, on a short walk before a desk."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import ConfigError
from mapper.core.geometry import exp, inverse, transform
from mapper.core.rotations import row_of_pose
from mapper.graph.components import by_odometry
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.pipeline.build import build
from mapper.pipeline.edit import edit_loops
from mapper.run.folder import open_run
from mapper.sources import open_source
from tests.support.command_line import mapper
from tests.support.files import files_of

# A keyframe every few frames, so that two seconds give enough of them to tie.
SETTINGS = ("odometry.max_keyframe_gap=4", "loops.min_gap_s=0.5", "loops.min_agreeing=0")


@pytest.fixture(scope="module")
def built(desk_log, tmp_path_factory):
    config = load_config(None, SETTINGS)
    return build(open_source(desk_log), config, tmp_path_factory.mktemp("loops") / "desk").path


@pytest.fixture
def run(built, tmp_path):
    return shutil.copytree(built, tmp_path / "run")


def held(run):
    return [(loop.i, loop.j) for loop in open_run(run).loops if loop.verdict == "accepted"]


def untied(run):
    """Two nodes that show nearly the same and are not known as a loop."""
    nodes = list(open_run(run).graph.T_world_node)
    known = {(loop.i, loop.j) for loop in open_run(run).loops}
    return next((i, j) for i, j in zip(nodes, nodes[2:], strict=False) if (i, j) not in known)


def test_lists_every_candidate(run):
    loops = open_run(run).loops
    assert loops
    head, *lines, total = mapper("loops", run).stdout.splitlines()
    assert head.split()[:3] == ["i", "j", "by"]
    assert [(int(line.split()[0]), int(line.split()[1])) for line in lines] == [(x.i, x.j) for x in loops]
    assert total == f"{len(held(run))} of {len(loops)} hold"
    shown = mapper("loops", run, "--accepted").stdout.splitlines()
    assert len(shown) == len(held(run)) + 2


def test_an_added_loop_is_a_factor_and_moves_what_hangs_on_it(run):
    i, j = untied(run)
    before, nodes = open_run(run), open_run(run).graph.T_world_node
    result = mapper("loops", run, "--add", j, i)
    after = open_run(run)

    added = after.loops[-1]
    assert (added.i, added.j, added.proposed_by, added.verdict) == (i, j, "hand", "accepted")
    assert after.graph.factors[-1].origin == "loop"
    assert (after.graph.factors[-1].i, after.graph.factors[-1].j) == (i, j)
    assert after.manifest.counts.loops == before.manifest.counts.loops + 1 == len(held(run))
    assert after.manifest.counts.factors == before.manifest.counts.factors + 1
    assert "ATE RMSE" in result.stdout

    T = dict(zip(after.trajectory.stamps_ns.tolist(), after.trajectory.T_world_body, strict=True))
    graph = after.graph
    assert max(np.abs(graph.T_world_node[n] - nodes[n]).max() for n in nodes) > 1e-7
    for node, stamp_ns in graph.stamps_ns.items():
        np.testing.assert_allclose(T[stamp_ns], graph.T_world_node[node], atol=1e-9)


def test_removing_what_was_added_leads_back(run):
    before = open_run(run).trajectory
    i, j = untied(run)
    mapper("loops", run, "--add", i, j, "--quiet")
    mapper("loops", run, "--remove", j, i, "--quiet")
    after = open_run(run)
    assert after.loops[-1].reason == "hand: removed"
    assert (i, j) not in held(run)
    np.testing.assert_allclose(after.trajectory.T_world_body, before.T_world_body, atol=1e-6)


def test_several_edits_are_one_solve(run):
    gone, new = held(run)[0], untied(run)
    mapper("loops", run, "--remove", *gone, "--add", *new, "--quiet")
    assert gone not in held(run)
    assert new in held(run)
    factors = open_run(run).graph.factors
    assert [(f.i, f.j) for f in factors if f.origin == "loop"] == held(run)


def test_an_edits_file_makes_the_same_of_loops_and_regions_at_once(run, built, tmp_path):
    gone, new = held(run)[0], untied(run)
    edits = tmp_path / "edits.toml"
    edits.write_text(
        f"[[reject]]\nnodes = {list(gone)}\n[[accept]]\nnodes = {list(new)}\n[[keep]]\npath_radius_m = 2.0\n"
    )
    assert "keep path_radius_m = 2.0: " in mapper("edit", run, "--from", edits).stdout
    one_by_one = shutil.copytree(built, tmp_path / "one_by_one")
    mapper("loops", one_by_one, "--remove", *gone, "--add", *new, "--quiet")
    mapper("edit", one_by_one, "--keep", "--radius", 2.0, "--quiet")
    for name in ("loops.jsonl", "graph.g2o", "edits.toml", "map.octree", "cloud.ply"):
        assert (run / name).read_bytes() == (one_by_one / name).read_bytes()


def test_a_keyframe_that_was_moved_by_eye_moves_the_path(run, tmp_path):
    graph = open_run(run).graph
    i, *_, j = graph.T_world_node
    T_i_j = inverse(graph.T_world_node[i]) @ graph.T_world_node[j]
    up_m = np.array([0.0, -0.05, 0.0])  # of the camera
    edits = tmp_path / "edits.toml"
    nodes = f"[[accept]]\nnodes = [{j}, {i}]\nby_eye = true\n"
    row = row_of_pose(inverse(transform(T_i_j[:3, :3], T_i_j[:3, 3] + up_m))).tolist()
    edits.write_text(f"{nodes}translation_m = {row[:3]}\nrotation_xyzw = {row[3:]}\n")
    mapper("edit", run, "--from", edits, "--quiet")
    after = open_run(run)
    (loop,) = [loop for loop in after.loops if loop.proposed_by == "hand"]
    np.testing.assert_allclose(loop.T_i_j[:3, 3] - T_i_j[:3, 3], up_m, atol=1e-6)
    T_after = inverse(after.graph.T_world_node[i]) @ after.graph.T_world_node[j]
    assert -0.05 < (T_after - T_i_j)[1, 3] < 0.0
    edits.write_text(nodes)
    assert "by_eye: want translation_m" in mapper("edit", run, "--from", edits, status=1).stderr


def test_a_dropped_keyframe_is_in_no_map_and_ties_nothing(run, tmp_path):
    (i, j), before = held(run)[0], open_run(run)
    tracked = len(before.tracked_trajectory)
    edits = tmp_path / "edits.toml"
    edits.write_text(f"drop = [{j}]\n")
    mapper("edit", run, "--from", edits, "--quiet")
    after = open_run(run)
    assert [pair for pair in held(run) if j in pair] == []
    assert next(loop.rejected_by for loop in after.loops if (loop.i, loop.j) == (i, j)) == "hand"
    gone = {record.stamp_ns for record in before.records if record.node == j}
    assert gone.isdisjoint(after.tracked_trajectory.stamps_ns.tolist())
    assert len(after.tracked_trajectory) == tracked - len(gone)
    edits.write_text("drop = [900]\n")
    assert "node 900: cannot be dropped" in mapper("edit", run, "--from", edits, status=1).stderr


def test_the_maps_are_those_of_fusing_from_scratch(run):
    mapper("loops", run, "--add", *untied(run), "--quiet")
    edited = (run / "map.ot").read_bytes()
    (run / "scan_updates.bin").unlink()
    mapper("fuse", run, "--quiet")
    assert (run / "map.ot").read_bytes() == edited


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--add", "0", "900"], "loop 0 → 900: no node 900; the graph's nodes are 0 … "),
        (["--add", "1", "1"], "loop 1 → 1: a node cannot be connected to itself"),
        (["--add", "1"], "--add 1: want two nodes' numbers"),
        (["--add", "1", "x"], "--add 1 x: want two nodes' numbers"),
        (["--remove", "0", "1"], "loop 0 → 1: no loop of "),
        (["--add", "J", "I"], "loop I → J: there already"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_changes_nothing(run, arguments, message):
    before, (i, j) = files_of(run), held(run)[0]
    numbers = {"I": str(i), "J": str(j)}
    result = mapper("loops", run, *(numbers.get(word, word) for word in arguments), status=1)
    assert result.stderr.startswith(f"mapper: {message.replace('I → J', f'{i} → {j}')}")
    assert result.stderr.count("\n") == 1
    assert files_of(run) == before


@pytest.mark.parametrize(
    ("knob", "value", "reason"),
    [
        ('"min_matches": 45', '"min_matches": 4500', "matching: "),
        ('"robust_width": 4.1', '"robust_width": 0.0001', "solver: contradicts the rest of the graph"),
    ],
)
def test_a_loop_that_is_not_believed_is_refused(run, knob, value, reason):
    config = (run / "config.json").read_text()
    assert knob in config
    with open_run(run).changing(["config.json"]):
        (run / "config.json").write_text(config.replace(knob, value))
    before = files_of(run)
    i, j = untied(run)
    result = mapper("loops", run, "--add", i, j, status=1)
    assert f"loop {i} → {j}: not added; {reason}" in result.stderr
    assert files_of(run) == before


def test_a_graph_that_is_not_solved_takes_no_loops(run):
    built = open_run(run)
    graph = built.config.graph.model_copy(update={"solve": "none"})
    unsolved = replace(built, config=built.config.model_copy(update={"graph": graph}))
    with pytest.raises(ConfigError, match=r"graph\.solve=none, so loops change nothing"):
        edit_loops(built.open_log(), unsolved, add=[(0, 1)])


def test_odometry_alone_leaves_loops_out_and_the_first_node_where_it_is():
    step = exp(np.array([0.0, 0.0, 0.1]), np.array([1.0, 0.0, 0.0]))
    start = exp(np.array([0.2, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    graph = PoseGraph()
    for node in (4, 7, 9):
        graph.add_node(node, node, start)
    back = np.linalg.inv(step)
    graph.add_factors([BetweenFactor(4, 7, step, np.eye(6)), BetweenFactor(9, 7, back, np.eye(6))])
    graph.add_factors([BetweenFactor(4, 9, np.eye(4), np.eye(6), "loop")])
    found = by_odometry(graph)
    np.testing.assert_allclose(found[4], start)
    np.testing.assert_allclose(found[7], start @ step)
    np.testing.assert_allclose(found[9], start @ step @ step)
