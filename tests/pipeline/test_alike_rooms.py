"""Two rooms that look the same to the last pixel: only the wheels know that they are two."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.frames import RgbdFrame
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.pipeline.disconnected_components import largest_component
from mapper.pipeline.solve import solve
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.simulation.source import CameraSimulator
from mapper.sources.base import FrameRef, Log
from tests.support.desk_frames import DESK_WALK, desk_frames

APART_M = 10.0
PAUSE_NS = 12 * NS_PER_S
"""In which the camera is carried on without images."""


def entry(frame: RgbdFrame) -> FrameRef:
    return FrameRef(frame.stamp_ns, lambda _colour: frame)


@pytest.fixture(scope="module")
def log() -> Log:
    """The walk before a desk, and the same walk in a room alike, with exact wheels all the time."""
    frames, simulator = desk_frames(), CameraSimulator(DESK_WALK)
    later = [replace(frame, stamp_ns=frame.stamp_ns + PAUSE_NS) for frame in frames]
    entries = [entry(frame) for frame in (*frames, *later)]
    stamps_ns = np.array([known.stamp_ns for known in entries])
    truth = simulator.truth.T_world_body
    elsewhere = truth.copy()
    elsewhere[:, 0, 3] += APART_M
    poses = np.concatenate([truth, elsewhere])
    share = np.linspace(0.0, 1.0, 100)[1:-1]
    on_the_way = np.tile(truth[-1], (len(share), 1, 1))
    on_the_way[:, :3, 3] += share[:, None] * (elsewhere[0] - truth[-1])[:3, 3]
    pause_ns = frames[-1].stamp_ns + (share * (later[0].stamp_ns - frames[-1].stamp_ns)).astype(np.int64)
    order = np.argsort(all_ns := np.concatenate([stamps_ns, pause_ns]), kind="stable")
    wheels = Trajectory(all_ns[order], np.concatenate([poses, on_the_way])[order])
    return replace(
        simulator.log(),
        stamps_ns=stamps_ns,
        entry_at=entries.__getitem__,
        truth=Trajectory(stamps_ns, poses),
        wheels=wheels,
    )


def mapped(log: Log, *settings: str):
    config = load_config(None, list(settings))
    tracking = largest_component(track_log(log, config, progress=SILENT), progress=SILENT)
    solved = solve(tracking.graph, tracking.loops, config.graph)
    return replace(tracking, graph=solved.graph, loops=solved.loops)


def between_rooms(tracking, log: Log):
    begins_ns = log.stamps_ns[len(log) // 2]
    return [loop for loop in tracking.loops if loop.stamp_i_ns < begins_ns <= loop.stamp_j_ns]


def test_exact_wheels_keep_two_rooms_apart(log):
    tracking = mapped(log)
    assert len(tracking.placed) >= len(log) - 2
    assert ate_rmse_m(tracking.trajectory(), log.truth) < 0.1
    loops = between_rooms(tracking, log)
    assert loops
    assert all(loop.verdict == "rejected" for loop in loops)
    assert any("by wheels and odometry" in loop.reason for loop in loops)
    assert any(
        "agree with each other but not with the wheels" in found.sentence for found in tracking.warnings
    )


def test_without_wheels_they_are_one(log):
    """What the images alone say: both halves on the same spot, 10 m wrong."""
    tracking = mapped(log, "graph.wheels.use=false")
    assert ate_rmse_m(tracking.trajectory(), log.truth) > 0.4 * APART_M
