"""Parts of a path that nothing ties together, joined by images of one place from near and from far."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.geometry import inverse
from mapper.graph.components import components
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.loops.config import NoLoopsConfig
from mapper.pipeline.component_loops import joined
from mapper.pipeline.disconnected_components import largest_component
from mapper.pipeline.solve import solve
from mapper.pipeline.tracking_result import TrackingResult
from mapper.runtime.progress import SILENT
from tests.support.feature_room import track
from tests.support.logs import log_in_memory, memory_entry
from tests.support.stepped_wall import facing, painting, wall_image

SURE = PoseSigmas(rotation_rad=0.01, translation_m=0.01).information
INTERVAL_NS = 100_000_000
NEAR = [facing(0.1 + 0.05 * k, 0.0, -1.6) for k in range(4)]
FAR = [facing(-0.3, 0.3 - 0.05 * k, -5.5, yaw=0.1) for k in range(4)]
CONFIG = load_config(None, [], sensor="rgbd").model_copy(update={"workers": 1})


def broken(*paintings: int, pause_ns: int = 5_000_000_000):
    """A log of a near and of a far walk along walls, and its path in two parts whose relation is unknown."""
    elsewhere = facing(3.0, 1.0, 0.0, yaw=2.0)
    graph, tracks, entries = PoseGraph(), [], []
    for node, pose in enumerate([*NEAR, *FAR]):
        stamp_ns = INTERVAL_NS * node + (pause_ns if node >= len(NEAR) else 0)
        painted = painting(paintings[node // len(NEAR)])
        entries.append(memory_entry(stamp_ns, wall_image(painted, pose, stamp_ns)))
        tracked = pose if node < len(NEAR) else elsewhere @ pose
        tracks.append(track(node, stamp_ns, tracked))
        graph.add_node(node, stamp_ns, tracked)
    truth = [*NEAR, *FAR]
    graph.add_factors(
        BetweenFactor(k, k + 1, inverse(truth[k]) @ truth[k + 1], SURE) for k in (0, 1, 2, 4, 5, 6)
    )
    return log_in_memory(entries), TrackingResult(tuple(tracks), (), graph, (), {})


@pytest.fixture(scope="module")
def one_wall():
    return broken(1, 1)


def test_a_wall_seen_from_near_and_from_far_joins_two_parts(one_wall):
    log, tracking = one_wall
    result = joined(log, tracking, CONFIG, progress=SILENT)
    (loop,) = result.loops
    assert (loop.i < 4, loop.j >= 4, loop.verdict) == (True, True, "accepted")
    kept = largest_component(result, progress=SILENT)
    assert len(kept.placed) == 8
    graph = solve(kept.graph, kept.loops, CONFIG.graph).graph
    T_first_last = inverse(graph.T_world_node[0]) @ graph.T_world_node[7]
    assert np.linalg.norm((inverse(T_first_last) @ inverse(NEAR[0]) @ FAR[3])[:3, 3]) < 0.1


def test_walls_that_are_painted_otherwise_stay_apart():
    log, tracking = broken(1, 2)
    result = joined(log, tracking, CONFIG, progress=SILENT)
    assert result.loops == ()
    assert len(components(result.graph)) == 2


def test_without_loops_between_images_nothing_is_searched(one_wall):
    log, tracking = one_wall
    unread = replace(log, entry_at=lambda _: pytest.fail("a frame is read"))
    config = CONFIG.model_copy(update={"loops": NoLoopsConfig()})
    assert joined(unread, tracking, config, progress=SILENT) is tracking


def test_a_path_in_one_piece_is_left_alone(one_wall):
    log, tracking = one_wall
    graph = tracking.graph.with_factors(
        [*tracking.graph.factors, BetweenFactor(3, 4, inverse(NEAR[3]) @ FAR[0], SURE)]
    )
    unread = replace(log, entry_at=lambda _: pytest.fail("a frame is read"))
    whole = replace(tracking, graph=graph)
    assert joined(unread, whole, CONFIG, progress=SILENT) is whole
