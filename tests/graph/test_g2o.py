import gtsam
import numpy as np
import pytest

from mapper.core.errors import GraphError
from mapper.core.geometry import angle_between, exp
from mapper.graph.config import GraphConfig
from mapper.graph.g2o import read_g2o, write_g2o
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.graph.optimize import optimize
from tests.support.paths import POSE_GRAPHS
from tests.support.progress import Observer

needs_posegraphs = pytest.mark.skipif(not POSE_GRAPHS.is_dir(), reason=f"{POSE_GRAPHS} is not here")

VERTICES = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
INFORMATION = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
EDGE = f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {INFORMATION}\n"


def random_graph(n=20, seed=0):
    rng = np.random.default_rng(seed)
    graph = PoseGraph()
    for node in range(n):
        graph.add_node(node * 3, 1305031102175304000 + node, exp(rng.normal(0, 1, 3), rng.normal(0, 5, 3)))
    origins = ("odometry", "loop", "wheel")
    for k in range(2 * n):
        i, j = rng.choice(n, 2, replace=False) * 3
        root = rng.normal(0, 10, (6, 6))
        T_i_j = exp(rng.normal(0, 1, 3), rng.normal(0, 1, 3))
        graph.add_factors([BetweenFactor(int(i), int(j), T_i_j, root @ root.T + np.eye(6), origins[k % 3])])
    return graph


def test_a_graph_survives_the_file(tmp_path):
    graph = random_graph()
    write_g2o(tmp_path / "graph.g2o", graph)
    read = read_g2o(tmp_path / "graph.g2o")

    assert read.stamps_ns == graph.stamps_ns
    assert list(read.T_world_node) == list(graph.T_world_node)
    for node, T in graph.T_world_node.items():
        assert (read.T_world_node[node][:3, 3] == T[:3, 3]).all()
        assert angle_between(read.T_world_node[node][:3, :3], T[:3, :3]) < 1e-14
    for ours, theirs in zip(graph.factors, read.factors, strict=True):
        assert (theirs.i, theirs.j, theirs.origin) == (ours.i, ours.j, ours.origin)
        assert (theirs.T_i_j[:3, 3] == ours.T_i_j[:3, 3]).all()
        assert angle_between(theirs.T_i_j[:3, :3], ours.T_i_j[:3, :3]) < 1e-14
        assert (theirs.information == 0.5 * (ours.information + ours.information.T)).all()


def test_fixed_nodes_are_read_and_written(tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_text(f"{VERTICES}{EDGE}FIX 1\n")
    graph = read_g2o(path)
    assert graph.fixed == (1,)
    write_g2o(path, graph.with_poses(graph.T_world_node))
    assert "\nFIX 1\n" in path.read_text()
    assert read_g2o(path).fixed == (1,)
    path.write_text(f"{VERTICES}{EDGE}FIX 0 1\n")
    assert read_g2o(path).fixed == (0, 1)
    path.write_text(f"{VERTICES}{EDGE}FIX 5\n")
    with pytest.raises(GraphError, match=r"graph\.g2o:4: FIX of node 5, which is not in the graph"):
        read_g2o(path)


def test_gtsam_reads_the_same_problem(tmp_path):
    graph = random_graph(seed=1)
    path = tmp_path / "graph.g2o"
    write_g2o(path, graph)

    factors, values = gtsam.readG2o(str(path), True)

    assert factors.size() == len(graph.factors)
    assert sorted(values.keys()) == sorted(graph.T_world_node)
    for node, T in graph.T_world_node.items():
        np.testing.assert_allclose(values.atPose3(node).matrix(), T, atol=1e-12)
    ours = optimize(graph, GraphConfig(solve="none")).factor_errors
    theirs = [factors.at(k).error(values) for k in range(factors.size())]
    np.testing.assert_allclose(theirs, ours, rtol=1e-9)


@needs_posegraphs
def test_published_files_mean_what_gtsam_takes_them_for():
    path = POSE_GRAPHS / "smallGrid3D.g2o"
    factors, values = gtsam.readG2o(str(path), True)
    assert optimize(read_g2o(path), GraphConfig(solve="none")).error_before == pytest.approx(
        factors.error(values)
    )


def test_indefinite_information_is_what_gtsam_makes_of_it(tmp_path):
    """Eigen's Cholesky stops at the first pivot that is not positive; the published costs rest on that."""
    rng = np.random.default_rng(3)
    lines = [f"VERTEX_SE3:QUAT {k} {k} 0 0 0 0 0 1" for k in range(41)]
    indefinite = 0
    for k in range(40):
        root = rng.normal(0, 1, (6, 6))
        matrix = root @ root.T - 0.02 * k * np.eye(6)
        np.fill_diagonal(matrix, np.abs(matrix.diagonal()) + 0.1)
        indefinite += bool(np.linalg.eigvalsh(matrix)[0] <= 0.0)
        upper = " ".join(repr(float(value)) for value in matrix[np.triu_indices(6)])
        lines.append(f"EDGE_SE3:QUAT {k} {k + 1} 1.1 0.2 0 0 0 0.1 1 {upper}")
    path = tmp_path / "indefinite.g2o"
    path.write_text("\n".join(lines) + "\n")
    observer = Observer()
    graph = read_g2o(path, progress=observer)
    factors, values = gtsam.readG2o(str(path), True)

    assert 5 < indefinite < 35, "the test must hold both kinds"
    (note,) = observer.notes
    assert f"{indefinite} of 40 edges have indefinite information" in note
    for k, factor in enumerate(graph.factors):
        R = factors.at(k).noiseModel().R()
        np.testing.assert_allclose(factor.information, R.T @ R, rtol=1e-9, atol=1e-9)
    assert optimize(graph, GraphConfig(solve="none")).error_before == pytest.approx(factors.error(values))


def test_loops_of_a_foreign_file_are_guessed_by_their_ids(tmp_path):
    vertices = "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in range(4))
    edges = "".join(f"EDGE_SE2 {i} {j} 1 0 0 1 0 0 1 0 1\n" for i, j in ((0, 1), (2, 1), (0, 2), (3, 0)))
    path = tmp_path / "foreign.g2o"
    path.write_text(vertices + edges + "EDGE_SE2 1 3 1 0 0 1 0 0 1 0 1 # origin wheel\n")
    guessed = [factor.origin for factor in read_g2o(path, guess_loops=True).factors]
    assert guessed == ["odometry", "odometry", "loop", "loop", "wheel"]
    assert [factor.origin for factor in read_g2o(path).factors] == ["odometry"] * 4 + ["wheel"]


def foreign_file(path, *, ids, order):
    """Graph of a way with two loops; vertices have these ids and stand in the file in this order."""
    vertices = "".join(f"VERTEX_SE2 {ids[k]} {k} 0 0\n" for k in order)
    pairs = [*((k, k + 1) for k in range(7)), (0, 7), (2, 6)]
    path.write_text(vertices + "".join(f"EDGE_SE2 {ids[i]} {ids[j]} 1 0 0 1 0 0 1 0 1\n" for i, j in pairs))
    return path


@pytest.mark.parametrize(
    ("ids", "order"),
    [
        pytest.param([70, 10, 50, 30, 0, 60, 20, 40], range(8), id="random ids in the order of the way"),
        pytest.param([0, 10, 20, 30, 40, 50, 60, 70], [5, 2, 7, 0, 3, 6, 1, 4], id="ids along the way"),
    ],
)
def test_odometry_joins_neighbours_by_the_ids_or_in_the_file(tmp_path, ids, order):
    graph = read_g2o(foreign_file(tmp_path / "a.g2o", ids=ids, order=order), guess_loops=True)
    assert [factor.origin for factor in graph.factors] == ["odometry"] * 7 + ["loop"] * 2


def test_loops_are_not_guessed_where_no_order_is_that_of_the_way(tmp_path):
    path = foreign_file(
        tmp_path / "a.g2o", ids=[70, 10, 50, 30, 0, 60, 20, 40], order=[5, 2, 7, 0, 3, 6, 1, 4]
    )
    with pytest.raises(GraphError, match="of 7 pairs"):
        read_g2o(path, guess_loops=True)
    assert len(read_g2o(path).factors) == 9


def test_lines_of_two_kinds_keep_their_order(tmp_path):
    path = tmp_path / "mixed.g2o"
    path.write_text(
        "VERTEX_SE2 5 1 2 0.5\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\nVERTEX_SE2 3 0 0 0\n"
        f"EDGE_SE2 5 3 1 0 0 1 0 0 1 0 1\n{EDGE.replace(' 0 1 1 ', ' 5 1 1 ')}"
        "EDGE_SE2 3 1 1 0 0 1 0 0 1 0 1\n"
    )
    graph = read_g2o(path)
    assert list(graph.T_world_node) == [5, 1, 3]
    assert [(factor.i, factor.j) for factor in graph.factors] == [(5, 3), (5, 1), (3, 1)]
    np.testing.assert_allclose(
        graph.T_world_node[5][:2, :2], [[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]
    )


def test_the_first_node_is_fixed(tmp_path):
    write_g2o(tmp_path / "graph.g2o", random_graph())
    assert [line for line in (tmp_path / "graph.g2o").read_text().splitlines() if line[:3] == "FIX"] == [
        "FIX 0"
    ]


def test_files_of_others_need_no_notes(tmp_path):
    path = tmp_path / "foreign.g2o"
    path.write_text(f"\ufeff# in Zürich\n\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n{EDGE}{VERTICES}FIX 0\n")
    graph = read_g2o(path)
    assert graph.stamps_ns == {0: 0, 1: 1}
    assert [factor.origin for factor in graph.factors] == ["odometry"]
    np.testing.assert_array_equal(graph.factors[0].information, np.eye(6))


def test_gtsam_reads_a_graph_of_toro_alike(tmp_path):
    path = tmp_path / "toro.graph"
    lines = ["VERTEX2 0 0 0 0", "VERTEX2 1 1 0.5 0.25", "EDGE2 0 1 1.1 0.4 0.3 9 1 8 50 2 3"]
    path.write_text("\n".join(lines) + "\n")
    (factor,) = read_g2o(path).factors
    gtsam_graph, initial = gtsam.load2D(f"{path}", None, 0, False, False, gtsam.NoiseFormat.NoiseFormatTORO)
    planar = factor.information[np.ix_([3, 4, 2], [3, 4, 2])]
    np.testing.assert_allclose(gtsam_graph.at(0).noiseModel().information(), planar, rtol=1e-12)
    measured = gtsam_graph.at(0).measured()
    np.testing.assert_allclose(measured.matrix()[:2, 2], factor.T_i_j[:2, 3], atol=1e-12)
    assert initial.size() == 2


def test_edges_alone_are_chained_from_near_ids(tmp_path):
    edges = [(0, 3, 9.0), (0, 1, 1.0), (2, 1, -1.0), (2, 3, 1.0)]
    lines = [f"EDGE_SE2 {i} {j} {x} 0 0 1 0 0 1 0 1" for i, j, x in edges]
    (tmp_path / "edges.g2o").write_text("\n".join(lines))
    assert [T[0, 3] for T in read_g2o(tmp_path / "edges.g2o").T_world_node.values()] == [0.0, 1.0, 2.0, 3.0]


def test_landmarks_are_left_out(tmp_path):
    landmarks = "VERTEX_TRACKXYZ 7 1 0 2\nEDGE_SE3_TRACKXYZ 0 7 0 1 0 2 1 0 0 1 0 1\nVERTEX_XY 8 1 0\nFIX 7\n"
    (tmp_path / "landmarks.g2o").write_text(VERTICES + landmarks + EDGE)
    graph = read_g2o(tmp_path / "landmarks.g2o")
    assert (list(graph.T_world_node), len(graph.factors), graph.fixed) == ([0, 1], 1, ())


def test_exponents_of_fortran_are_read(tmp_path):
    (tmp_path / "e.g2o").write_text(VERTICES.replace(" 1 1 0", " 1 1.25e+01 0") + EDGE)
    (tmp_path / "D.g2o").write_text(VERTICES.replace(" 1 1 0", " 1 1.25D+01 0") + EDGE)
    one, other = (read_g2o(tmp_path / name).T_world_node[1] for name in ("e.g2o", "D.g2o"))
    assert one[0, 3] == other[0, 3] == 12.5


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        (VERTICES + "EDGE_SE3_XYZ 0 1 2\n", 3, "unknown tag 'EDGE_SE3_XYZ'"),
        (VERTICES + EDGE.replace(" 0 1 1 ", " 0 1 1,0 "), 3, "not a comma"),
        (VERTICES + EDGE.replace(" 0 1 1 ", " 0 9 1 "), 3, "node 9 is not in the graph"),
        (VERTICES + EDGE.replace(" 0 1 1 ", " 1 1 1 "), 3, "cannot be measured against itself"),
        (VERTICES + VERTICES, 3, "node 0 is in the graph already"),
        (VERTICES.replace(" 1 1 0", " 1 nan 0"), 2, "not finite"),
        (VERTICES.replace(" 1 1 0", " 1 one 0"), 2, "could not convert string to float"),
        (VERTICES.replace("0 0 0 1", "0 0 0 0"), 1, "no direction"),
        (VERTICES + EDGE.replace(INFORMATION, "-" + INFORMATION), 3, "not positive definite"),
        (VERTICES + EDGE.replace(INFORMATION, "0" + INFORMATION[1:]), 3, "a diagonal value is not positive"),
        (VERTICES + EDGE.replace(INFORMATION, "nan" + INFORMATION[1:]), 3, "not finite"),
        (VERTICES + EDGE.replace(INFORMATION, "inf" + INFORMATION[1:]), 3, "not finite"),
        (VERTICES + EDGE + EDGE.replace("0 0 0 1 1", "0 0 0 0 1"), 4, "no direction"),
        (VERTICES.replace("QUAT 1", "QUAT -1"), 2, "an id is negative"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0\n", 2, "3 columns after the tag, want 4"),
        (
            "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 0\n",
            3,
            "not positive definite",
        ),
        (VERTICES + EDGE.replace(INFORMATION, INFORMATION[2:]), 3, "29 columns after the tag, want 30"),
        (VERTICES + EDGE.strip() + " # origin guess\n", 3, "origin 'guess': want one of odometry, loop"),
        ("VERTEX_SE3:QUAT 9223372036854775808 0 0 0 0 0 0 1\n", 1, "an id is more than"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 90 1 0 0 1 0 1\n", 3, "want radians"),
        ("VERTEX_SE3:QUAT a 0 0 0 0 0 0 1\n", 1, "whole numbers"),
    ],
)
def test_a_bad_line_is_named(tmp_path, text, line, message):
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(GraphError) as caught:
        read_g2o(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert message in str(caught.value)


def test_a_bad_file_is_named(tmp_path):
    path = tmp_path / "bad.g2o"
    with pytest.raises(GraphError, match=r"bad\.g2o: cannot be read: No such file"):
        read_g2o(path)
    path.write_bytes(b"\x89PNG\r\n")
    with pytest.raises(GraphError, match="byte 0 is not UTF-8"):
        read_g2o(path)
    path.write_text("\n")
    with pytest.raises(GraphError, match="no poses"):
        read_g2o(path)
    with pytest.raises(GraphError, match="without nodes"):
        write_g2o(path, PoseGraph())
