"""A camera that walks over a floor, with a graph that sinks and tilts; only the floor is in view."""

from types import SimpleNamespace

import numpy as np
import pytest

from mapper.config.build import BuildConfig
from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import apply, exp, inverse, rotation_exp, transform
from mapper.graph.model import PoseSigmas
from mapper.pipeline.floor import UP_LEVEL, above_floor
from tests.support.logs import log_in_memory
from tests.support.noisy_graphs import drifted_chain

COUNT = 30
_DEFAULTS = BuildConfig()
_SIGMAS = PoseSigmas(rotation_rad=0.006, translation_m=0.01)
_LOOK = rotation_exp(np.array([0.0, 0.5, 0.0])) @ np.array(
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
)
TRUTH = [transform(_LOOK, np.array([0.4 * k, 0.0, 1.4])) for k in range(COUNT)]


def drifted():
    return drifted_chain(TRUTH, exp(np.radians([0.2, 0.0, 0.0]), np.zeros(3)), _SIGMAS)


def scan_at(k):
    if k == 3:
        raise FrameError("unreadable")
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(1.2, 3.2, 50), np.linspace(-1.0, 1.0, 50)))
    points = np.column_stack([x + 0.4 * k, y, np.random.default_rng(k).normal(0.0, 0.004, len(x))])
    return Scan(k, apply(inverse(TRUTH[k]), points).astype(np.float32), np.zeros(3))


def log_of(sensor="rgbd"):
    entries = [SimpleNamespace(stamp_ns=k, scan=lambda k=k: scan_at(k)) for k in range(COUNT)]
    return log_in_memory(entries, sensor=sensor)


def followed(graph, config=_DEFAULTS, sensor="rgbd", trusted_ns=range(COUNT)):
    return above_floor(log_of(sensor), graph, config, up_world=UP_LEVEL, trusted_ns=trusted_ns)


def test_a_path_gets_the_height_of_its_floor_and_keeps_its_factors():
    graph = drifted()
    assert abs(graph.T_world_node[COUNT - 1][2, 3] - 1.4) > 0.4
    after, nodes = followed(graph)
    assert nodes == COUNT - 1, "the floor of all but the unreadable frame"
    assert [T[2, 3] for T in after.T_world_node.values()] == pytest.approx([1.4] * COUNT, abs=0.1)
    assert after.factors == graph.factors
    assert np.allclose(after.T_world_node[0], TRUTH[0])


@pytest.mark.parametrize(
    ("overrides", "sensor"),
    [
        ({"level": {"follow_floor": False}}, "rgbd"),
        ({"graph": {"solve": "none"}}, "rgbd"),
        ({"odometry": {"kind": "given"}}, "rgbd"),
        ({}, "lidar"),
    ],
)
def test_a_graph_stays_where_the_floor_is_not_followed(overrides, sensor):
    graph = drifted()
    assert followed(graph, BuildConfig.model_validate(overrides), sensor) == (graph, 0)


def test_doubtful_frames_show_no_floor():
    graph = drifted()
    assert followed(graph, trusted_ns=range(5)) == (graph, 0)
