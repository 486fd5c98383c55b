"""Parts of a path that nothing ties together, and what becomes of them."""

import numpy as np
import pytest

from mapper.core.geometry import inverse
from mapper.graph.components import align_components
from mapper.graph.config import GraphConfig
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.loops.closure import LoopClosure
from mapper.pipeline.components import DISCONNECTED, largest_component
from mapper.pipeline.solve import solve
from mapper.pipeline.tracking_result import TrackingResult
from mapper.runtime.progress import SILENT
from tests.support.feature_room import track
from tests.support.planar import at

SURE = PoseSigmas(rotation_rad=0.01, translation_m=0.01).information


class Listener:
    """Keeps what it is told."""

    stage = SILENT.stage

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, message: str) -> None:
        self.notes.append(message)


def two_parts(*, tied: bool) -> TrackingResult:
    """Nodes 0 to 2 and, begun anew and turned round, 3 to 7; truly all a metre apart on a line."""
    truth = {node: at(float(node)) for node in range(8)}
    turned = at(2.0, yaw=2.5)
    estimates = {node: T if node < 3 else turned @ inverse(truth[3]) @ T for node, T in truth.items()}
    graph = PoseGraph()
    tracks = []
    for node, T in estimates.items():
        tracks.append(track(node, 10 * node, T))
        graph.add_node(node, 10 * node, T)
    graph.add_factors(BetweenFactor(k, k + 1, at(1.0), SURE) for k in (0, 1, 3, 4, 5, 6))
    inner = LoopClosure(0, 2, 0, 20, "places", "accepted", T_i_j=at(2.0), information=SURE)
    outer = LoopClosure(1, 5, 10, 50, "places", "accepted", T_i_j=at(4.0), information=SURE)
    loops = (inner, outer) if tied else (inner,)
    graph.add_factors(loop.factor for loop in loops)
    return TrackingResult(tuple(tracks), (), graph, loops, {})


def test_only_the_largest_part_is_kept_and_it_is_said():
    listener = Listener()
    kept = largest_component(two_parts(tied=False), progress=listener)
    assert sorted(kept.graph.T_world_node) == [3, 4, 5, 6, 7]
    assert [t.node for t in kept.tracks] == [None, None, None, 3, 4, 5, 6, 7]
    assert kept.tracks[0].diagnostics.method == DISCONNECTED
    assert [(loop.verdict, loop.reason.split(":")[0]) for loop in kept.loops] == [
        ("rejected", "disconnected")
    ]
    assert {(f.i, f.j) for f in kept.graph.factors} == {(3, 4), (4, 5), (5, 6), (6, 7)}
    assert len(kept.trajectory()) == 5
    (note,) = listener.notes
    assert note.startswith("3 of 8 frames lie in 1 parts")


def test_what_a_loop_ties_is_kept_whole():
    listener = Listener()
    tracking = two_parts(tied=True)
    assert largest_component(tracking, progress=listener) is tracking
    assert listener.notes == []


def test_a_part_is_laid_where_the_loop_wants_it():
    laid = align_components(two_parts(tied=True).graph)
    for node, T in laid.T_world_node.items():
        np.testing.assert_allclose(T, at(float(node)), atol=1e-9)
    assert list(laid.T_world_node) == list(range(8))


def test_a_part_without_a_tie_stays():
    graph = two_parts(tied=False).graph
    laid = align_components(graph)
    for node, T in laid.T_world_node.items():
        np.testing.assert_array_equal(T, graph.T_world_node[node])


@pytest.mark.parametrize("robust", ["gnc", "none"])
def test_the_solver_finds_the_line(robust):
    tracking = two_parts(tied=True)
    solved = solve(tracking.graph, tracking.loops, GraphConfig(robust=robust))
    assert [loop.verdict for loop in solved.loops] == ["accepted", "accepted"]
    assert solved.report.components == 1
    for node, T in solved.graph.T_world_node.items():
        np.testing.assert_allclose(T, at(float(node)), atol=1e-6)
