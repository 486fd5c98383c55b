"""Places of an earlier session, recognised while a later one walks through the same made-up room."""

from functools import partial

import numpy as np
import pytest

from mapper.core.errors import ConfigError
from mapper.core.geometry import exp, inverse
from mapper.core.timebase import NS_PER_S
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.loops.closure import discrepancy
from mapper.loops.config import PlaceLoopsConfig
from mapper.loops.factory import build_loop_detector
from tests.support.feature_room import LAP, LINK, PLACES, Room, track, walked

T_OTHER_WORLD = exp(np.array([0.2, 0.1, 2.0]), np.array([7.0, -4.0, 0.5]))
CLOSE_IN_TIME_NS = NS_PER_S // 100


def link(i, j, T_world_i, T_world_j):
    return BetweenFactor(i, j, inverse(T_world_i) @ T_world_j, LINK)


def preloaded(config, room):
    """A loop detector preloaded with one lap of the room."""
    truth = walked()[:LAP]
    graph = PoseGraph(dict(enumerate(truth)), {k: k * CLOSE_IN_TIME_NS for k in range(LAP)})
    graph.add_factors(link(k, k + 1, truth[k], truth[k + 1]) for k in range(LAP - 1))
    detector = build_loop_detector(config, "batch")
    detector.preload(graph, {k: room.view(T, graph.stamps_ns[k]) for k, T in graph.T_world_node.items()})
    return detector


def come_back(detector, room):
    """Walk the lap again, as seen from a world of its own that begins where the camera is."""
    truth = walked()[:LAP]
    poses = [T_OTHER_WORLD @ T for T in truth]
    for k in range(LAP):
        node, stamp_ns = LAP + k, (LAP + k) * CLOSE_IN_TIME_NS
        links = [link(node - 1, node, poses[k - 1], poses[k])] if k else []
        view = partial(room.view, truth[k], stamp_ns)
        detector.add(node, track(node, stamp_ns, poses[k], links), view)


def test_what_was_seen_before_is_recognised_however_little_time_lies_between():
    truth, room = walked(), Room(1)
    detector = preloaded(PlaceLoopsConfig(places=PLACES, min_motion_m=0.0), room)
    come_back(detector, room)
    held = [loop for loop in detector.closures() if loop.verdict == "accepted"]
    assert len(held) >= 0.8 * LAP
    assert all(loop.i < LAP <= loop.j for loop in held)
    for loop in held:
        assert discrepancy(loop.T_i_j, truth[loop.i], truth[loop.j - LAP]).translation_m < 0.05
        assert loop.stamp_j_ns - loop.stamp_i_ns < NS_PER_S, "the stamps are the frames' own"


def test_the_later_session_is_estimated_in_the_earlier_one_s_world():
    room = Room(1)
    detector = preloaded(PlaceLoopsConfig(places=PLACES), room)
    come_back(detector, room)
    for k, T_world_body in enumerate(walked()[:LAP]):
        np.testing.assert_allclose(detector.current_estimate(k), T_world_body, atol=0.05)
        np.testing.assert_allclose(detector.current_estimate(LAP + k), T_world_body, atol=0.1)


def test_nothing_is_proposed_by_pose_before_a_loop_ties_the_sessions():
    detector = preloaded(PlaceLoopsConfig(places=PLACES, max_distance_m=100.0, max_angle_rad=3.1), Room(1))
    come_back(detector, Room(2))
    assert not any(loop.proposed_by == "nearby" for loop in detector.closures() if loop.i < LAP)
    assert not any(loop.verdict == "accepted" for loop in detector.closures())


def test_pose_alone_recognises_no_other_session():
    with pytest.raises(ConfigError, match=r"want loops\.propose=auto or places, and an ORB detector"):
        preloaded(PlaceLoopsConfig(propose="nearby"), Room(1))
