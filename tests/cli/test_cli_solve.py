"""``mapper solve`` from the command line."""

import json

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, transform
from mapper.graph.g2o import read_g2o, write_g2o
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.sources.trajectory_files import read_tum
from tests.support.command_line import mapper

INFORMATION = PoseSigmas(rotation_rad=0.01, translation_m=0.02).information


def ring(n=20, *, seed=0):
    """Truth, and a graph of it whose estimates drift and whose last node sees the first four again."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, 2.0 * np.pi, n)
    truth = [
        exp(np.array([0.0, 0.0, a]), np.zeros(3)) @ transform(np.eye(3), [2.0, 0.0, 0.0]) for a in angles
    ]
    graph = PoseGraph()
    graph.add_node(0, 10**9, truth[0])
    for k in range(1, n):
        error = exp(rng.normal(0, 0.01, 3), rng.normal(0, 0.02, 3))
        T_before_here = inverse(truth[k - 1]) @ truth[k] @ error
        graph.add_node(k, (k + 1) * 10**9, graph.T_world_node[k - 1] @ T_before_here)
        graph.add_factors([BetweenFactor(k - 1, k, T_before_here, INFORMATION)])
    graph.add_factors(
        BetweenFactor(k, n - 1, inverse(truth[k]) @ truth[n - 1], INFORMATION, "loop") for k in range(4)
    )
    return graph, truth


def with_a_false_loop(graph):
    wrong = transform(np.eye(3), [0.0, 0.0, 3.0])
    graph.add_factors([BetweenFactor(5, 12, wrong, INFORMATION, "loop")])
    return graph


@pytest.mark.parametrize(("robust", "is_contradicting"), [("none", True), ("gnc", False)])
def test_edges_that_contradict_each_other_are_named(tmp_path, robust, is_contradicting):
    graph, _ = ring()
    write_g2o(tmp_path / "ring.g2o", with_a_false_loop(graph))

    result = mapper("solve", tmp_path / "ring.g2o", "--robust", robust, "--out", tmp_path / "out")

    report = json.loads((tmp_path / "out/solve.json").read_text())
    assert (report["chi2_per_freedom"] > 10.0) == is_contradicting
    assert ("contradict each other" in result.stderr) == is_contradicting


def test_a_folder_holds_graph_path_picture_and_report(tmp_path):
    graph, truth = ring()
    write_g2o(tmp_path / "ring.g2o", with_a_false_loop(graph))

    shown = mapper("solve", tmp_path / "ring.g2o", "--out", tmp_path / "out").stdout

    report = json.loads((tmp_path / "out/solve.json").read_text())
    found = [report[name] for name in ("nodes", "edges", "loops", "rejected", "component_sizes")]
    assert found == [20, 24, 5, [[5, 12]], [20]]
    assert 0.0 < report["error_after"] < report["error_before"]
    assert "4 of 5 accepted" in shown
    again = read_g2o(tmp_path / "out/graph.g2o")
    assert [(factor.i, factor.j) for factor in again.factors if factor.origin == "loop"].count((5, 12)) == 0
    assert len(again.factors) == 23, "the line of the rejected edge is a comment"
    assert np.linalg.norm(again.T_world_node[19][:3, 3] - truth[19][:3, 3]) < 0.05
    path = read_tum(tmp_path / "out/keyframes.tum")
    assert path.stamps_ns.tolist() == list(graph.stamps_ns.values())
    np.testing.assert_allclose(path.T_world_body[7], again.T_world_node[7], atol=1e-12)
    assert (tmp_path / "out/graph.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_is_the_same_graph_with_solved_nodes(tmp_path):
    graph, _ = ring()
    write_g2o(tmp_path / "ring.g2o", graph)
    result = mapper("solve", tmp_path / "ring.g2o", "--out", tmp_path / "out.g2o", "--quiet")
    assert result.stdout == ""
    again = read_g2o(tmp_path / "out.g2o")
    assert again.stamps_ns == graph.stamps_ns
    assert len(again.factors) == len(graph.factors)
    assert (again.T_world_node[19] != graph.T_world_node[19]).any()


def stripped(path):
    """The same graph as somebody else would have written it."""
    text = "\n".join(line.partition("#")[0] for line in path.read_text().splitlines())
    path.write_text(text + "\n")
    return path


def test_a_foreign_file_is_plain_least_squares_unless_doubt_is_asked_for(tmp_path):
    write_g2o(tmp_path / "ring.g2o", with_a_false_loop(ring()[0]))
    foreign = stripped(tmp_path / "ring.g2o")
    plain = mapper("solve", foreign, "--out", tmp_path / "plain").stdout
    mapper("solve", foreign, "--out", tmp_path / "robust", "--robust", "dcs")
    plain_report = json.loads((tmp_path / "plain/solve.json").read_text())
    robust_report = json.loads((tmp_path / "robust/solve.json").read_text())
    assert plain_report["loops"] == 0
    assert "accepted" not in plain
    assert robust_report["loops"] == 5
    assert robust_report["rejected"] == [[5, 12]]
    assert robust_report["error_after"] < 0.1 * plain_report["error_after"]


def test_components_are_reported(tmp_path):
    graph, _ = ring()
    graph.add_node(100, 100 * 10**9, np.eye(4))
    graph.add_node(101, 101 * 10**9, np.eye(4))
    graph.add_factors([BetweenFactor(100, 101, transform(np.eye(3), [1.0, 0.0, 0.0]), INFORMATION)])
    write_g2o(tmp_path / "two.g2o", graph)
    shown = mapper("solve", tmp_path / "two.g2o", "--out", tmp_path / "out.g2o").stdout
    assert "2, each solved on its own: 20, 2 nodes" in shown
    assert read_g2o(tmp_path / "out.g2o").T_world_node[101][0, 3] == pytest.approx(1.0)


def test_every_knob_of_the_graph_turns_and_one_that_is_none_is_refused(tmp_path):
    write_g2o(tmp_path / "ring.g2o", ring()[0])
    knobs = ("--robust", "none", "--initial", "given", "--set", "graph.max_iterations=1")
    mapper("solve", tmp_path / "ring.g2o", "--out", tmp_path / "out", *knobs)
    report = json.loads((tmp_path / "out/solve.json").read_text())
    found = (report["iterations"], report["config"]["initial"], report["config"]["robust"])
    assert found == (1, "given", "none")
    for setting, message in (
        ("octree.resolution_m=1", "octree: unknown; known are"),
        ("max_iterations=0", "max_iterations: want more than 0"),
    ):
        refused = mapper("solve", tmp_path / "ring.g2o", "--out", tmp_path / "b", "--set", setting, status=1)
        assert message in refused.stderr


def test_what_is_there_is_neither_replaced_nor_written_into(tmp_path):
    path, folder = tmp_path / "ring.g2o", tmp_path / "out"
    write_g2o(path, ring()[0])
    folder.mkdir()
    before = path.read_bytes()
    for out in (path, folder):
        assert f"{out.name}: exists already" in mapper("solve", path, "--out", out, status=1).stderr
    assert path.read_bytes() == before
    assert not any(folder.iterdir())
