from dataclasses import replace

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.core.geometry import adjoint, exp, inverse
from mapper.graph.components import align_components
from mapper.graph.config import GraphConfig
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.pipeline.disconnected_components import DISCONNECTED, largest_component, without_doubtful_ends
from mapper.pipeline.solve import solve
from mapper.pipeline.tracking_result import TrackingResult
from tests.support.feature_room import track
from tests.support.loop_closures import SURE, loop
from tests.support.planar import at
from tests.support.progress import Observer


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
    inner, outer = loop(0, 2, at(2.0)), loop(1, 5, at(4.0))
    loops = (inner, outer) if tied else (inner,)
    graph.add_factors(each.factor for each in loops)
    return TrackingResult(tuple(tracks), (), graph, loops, {})


def test_only_the_largest_part_is_kept_and_it_is_said():
    listener = Observer()
    kept = largest_component(two_parts(tied=False), progress=listener)
    assert sorted(kept.graph.T_world_node) == [3, 4, 5, 6, 7]
    assert [t.node for t in kept.tracks] == [None, None, None, 3, 4, 5, 6, 7]
    assert kept.tracks[0].diagnostics.method == DISCONNECTED
    assert [(each.verdict, each.reason.split(":")[0]) for each in kept.loops] == [
        ("rejected", "disconnected")
    ]
    assert {(f.i, f.j) for f in kept.graph.factors} == {(3, 4), (4, 5), (5, 6), (6, 7)}
    assert len(kept.trajectory()) == 5
    (note,) = listener.notes
    assert note.startswith("3 of 8 frames lie in 1 parts")


def test_what_a_loop_ties_is_kept_whole():
    listener = Observer()
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
    assert [each.verdict for each in solved.loops] == ["accepted", "accepted"]
    assert solved.report.components == 1
    for node, T in solved.graph.T_world_node.items():
        np.testing.assert_allclose(T, at(float(node)), atol=1e-6)


STEP = exp(np.array([0.0, 0.0, 0.2]), np.array([0.5, 0.1, 0.0]))
SIGMAS = PoseSigmas(0.2, 1.0)
DOUBTS = (Doubt("disagreement", "another pose fits as well"),)


def frame(index, node, T_world, T_node_body, *, doubts=(), sigma=0.1):
    """Return a frame's result; one at its node is its keyframe."""
    how = Diagnostics(100, 50, 40, 0.01, "m", "map")
    is_keyframe = bool(np.array_equal(T_node_body, np.eye(4)))
    T_world_body, covariance = T_world @ T_node_body, np.eye(6) * sigma**2
    return FrameResult(
        index, node, T_node_body, T_world_body, is_keyframe, how, doubts=doubts, covariance=covariance
    )


def chain(links):
    """Return a graph with a factor from each pair of nodes, and the poses of the nodes."""
    poses = {0: np.eye(4)}
    for i, j in links:
        poses.setdefault(j, poses[i] @ STEP)
    factors = [BetweenFactor(i, j, inverse(poses[i]) @ poses[j], SIGMAS.information) for i, j in links]
    return PoseGraph(poses, {node: node for node in poses}, factors), poses


def keyframes(poses, *, doubted):
    return [
        frame(node, node, T, np.eye(4), doubts=DOUBTS if node in doubted else ()) for node, T in poses.items()
    ]


def test_a_doubtful_keyframe_at_the_end_of_one_factor_becomes_a_frame():
    graph, poses = chain([(0, 1), (1, 2), (1, 3)])
    tracks = keyframes(poses, doubted={2})

    changed, left = without_doubtful_ends(tracks, graph)

    assert sorted(left.T_world_node) == [0, 1, 3]
    assert [(f.i, f.j) for f in left.factors] == [(0, 1), (1, 3)]
    assert (changed[2].node, changed[2].is_keyframe, changed[2].doubts) == (1, False, DOUBTS)
    np.testing.assert_allclose(poses[1] @ changed[2].T_node_body, poses[2], atol=1e-12)
    np.testing.assert_allclose(changed[2].covariance, np.linalg.inv(SIGMAS.information), atol=1e-12)
    assert [changed[k] is tracks[k] for k in (0, 1, 3)] == [True] * 3


def test_its_doubtful_frames_and_a_doubtful_keyframe_behind_it_go_with_it():
    graph, poses = chain([(0, 1), (1, 2), (2, 3), (1, 4)])
    tracks = keyframes(poses, doubted={2, 3})
    tracks.insert(3, frame(9, 2, poses[2], STEP, doubts=DOUBTS))

    changed, left = without_doubtful_ends(tracks, graph)

    assert sorted(left.T_world_node) == [0, 1, 4]
    assert [track.node for track in changed] == [0, 1, 1, 1, 1, 4]
    for k, T in ((3, poses[2] @ STEP), (4, poses[3])):
        np.testing.assert_allclose(poses[1] @ changed[k].T_node_body, T, atol=1e-12)
    Ad = adjoint(inverse(STEP))
    of_keyframe = Ad @ np.linalg.inv(SIGMAS.information) @ Ad.T
    np.testing.assert_allclose(changed[3].covariance, of_keyframe + 0.1**2 * np.eye(6), atol=1e-9)


@pytest.mark.parametrize("case", ["loop", "tracked frame", "goes on", "no doubt"])
def test_a_keyframe_that_something_goes_on_from_stays(case):
    links = {"loop": [(0, 1), (1, 2), (0, 2)], "goes on": [(0, 1), (1, 2), (2, 3)]}
    graph, poses = chain(links.get(case, [(0, 1), (1, 2)]))
    tracks = keyframes(poses, doubted=() if case == "no doubt" else {2})
    if case == "tracked frame":
        tracks.append(frame(9, 2, poses[2], STEP))

    changed, left = without_doubtful_ends(tracks, graph)

    assert changed == tracks
    assert left is graph


def test_the_first_keyframe_stays():
    graph, poses = chain([(0, 1)])
    tracks = [replace(track, doubts=DOUBTS) for track in keyframes(poses, doubted=())]
    changed, left = without_doubtful_ends(tracks, graph)
    assert [track.is_keyframe for track in changed] == [True, False]
    assert list(left.T_world_node) == [0]
