"""A path that jumps in a map although its odometry saw nothing: it is cut there, and only there."""

import numpy as np

from mapper.core.timebase import NS_PER_S
from mapper.graph.components import components
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.loops.closure import LoopClosure
from mapper.loops.config import GateConfig
from mapper.pipeline.localise import without_jumps
from mapper.pipeline.tracking_result import TrackingResult
from mapper.run.frame_records import DISCONNECTED
from mapper.runtime.progress import SILENT
from tests.support.feature_room import track
from tests.support.planar import at

MAP = 100
SURE = PoseSigmas(rotation_rad=0.01, translation_m=0.05).information


def path(true_x_m, constrained, wrong=()):
    """Nodes whose odometry is a straight line, a metre apart; their poses in the map, where constrained."""
    graph = PoseGraph({MAP: np.eye(4)}, {MAP: 0})
    tracks, loops = [], []
    for k, x_m in enumerate(true_x_m):
        node = MAP + 1 + k
        graph.add_node(node, (k + 1) * NS_PER_S, at(float(k)))
        tracks.append(track(node, (k + 1) * NS_PER_S, at(float(k))))
        if k:
            graph.add_factors([BetweenFactor(node - 1, node, at(1.0), SURE)])
        if k in constrained:
            T = at(x_m, 7.0 if k in wrong else 0.0)
            stamp_ns = (k + 1) * NS_PER_S
            loops.append(LoopClosure(MAP, node, 0, stamp_ns, "places", "accepted", T_i_j=T, information=SURE))
    graph.add_factors(loop.factor for loop in loops)
    return TrackingResult(tuple(tracks), (), graph, tuple(loops), {})


def parts(tracking):
    factors = [factor for factor in tracking.graph.factors if factor.origin != "loop"]
    of_odometry = components(PoseGraph(tracking.graph.T_world_node, tracking.graph.stamps_ns, factors))
    return [[node - MAP - 1 for node in nodes] for nodes in of_odometry if nodes != [MAP]]


def test_a_steady_path_is_not_cut_nor_is_one_with_a_wrong_constraint():
    drifting = [1.02 * k for k in range(20)]
    for wrong in ((), (9,), (0, 19)):
        before = path(drifting, range(20), wrong)
        after = without_jumps(before, MAP, GateConfig(), progress=SILENT)
        assert after is before


def test_a_jump_is_cut_between_the_constraints_around_it():
    true_x_m = [k if k < 10 else 40.0 + k for k in range(20)]
    constrained = [*range(9), *range(12, 20)]
    cut = without_jumps(path(true_x_m, constrained), MAP, GateConfig(), progress=SILENT)
    assert parts(cut) == [list(range(9)), [9], [10], [11], list(range(12, 20))]
    assert [k for k, track in enumerate(cut.tracks) if track.node is None] == [9, 10, 11]
    assert cut.tracks[9].diagnostics.method == DISCONNECTED
    assert len(cut.loops) == len(constrained)
    assert sum(factor.origin == "loop" for factor in cut.graph.factors) == len(constrained)


def test_there_and_back_are_two_jumps():
    true_x_m = [k if k < 8 or k >= 16 else -30.0 + k for k in range(24)]
    cut = without_jumps(path(true_x_m, range(24)), MAP, GateConfig(), progress=SILENT)
    assert parts(cut) == [list(range(8)), list(range(8, 16)), list(range(16, 24))]


def test_too_few_constraints_cut_nothing():
    true_x_m = [k if k < 10 else 40.0 + k for k in range(20)]
    before = path(true_x_m, [3, 5, 7, 15, 18])
    assert without_jumps(before, MAP, GateConfig(), progress=SILENT) is before
