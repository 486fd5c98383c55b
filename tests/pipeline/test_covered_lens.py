"""Wheels connect the parts of a log before and after a covered lens."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapper.config.loading import load_config, overridden
from mapper.core.geometry import angle_between, exp, inverse
from mapper.core.trajectory import Trajectory
from mapper.odometry.keyframes.tracking import MOST_LOST_FRAMES
from mapper.pipeline.disconnected_components import largest_component
from mapper.pipeline.solve import solve
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.simulation.config import SynthConfig
from mapper.simulation.source import CameraSimulator
from tests.support.logs import memory_entry


@pytest.fixture(scope="module")
def interrupted():
    """A walk during which the lens is covered for five seconds, and wheels that drift on the way."""
    source = CameraSimulator(
        SynthConfig(
            duration_s=10.0,
            frame_rate_hz=10.0,
            width_px=320,
            height_px=240,
            texture_px_per_m=96,
            blackout_start_s=2.0,
            blackout_duration_s=5.0,
        )
    ).log()
    rng = np.random.default_rng(4)
    truth, T = source.truth.T_world_body, [np.eye(4)]
    for before, after in pairwise(truth):
        step = inverse(before) @ after
        step[:3, 3] *= 1.02
        T.append(T[-1] @ step @ exp(rng.normal(0.0, 5e-4, 3), rng.normal(0.0, 5e-4, 3)))
    entries = [memory_entry(entry.stamp_ns, entry.load()) for entry in source.entries()]  # drawn once
    return replace(source, entry_at=entries.__getitem__, wheels=Trajectory(source.stamps_ns, np.array(T)))


def mapped(source, config):
    tracking = largest_component(track_log(source, config, progress=SILENT), progress=SILENT)
    solved = solve(tracking.graph, tracking.loops, config.graph)
    return replace(tracking, graph=solved.graph).trajectory()


@pytest.mark.slow
def test_wheels_connect_what_is_before_and_after_a_covered_lens(interrupted):
    config = load_config(None, ["loops.kind=none"])
    alone = mapped(interrupted, overridden(config, ["graph.wheels.use=false"]))
    connected = mapped(interrupted, config)
    covered, begun_anew_after = 50, MOST_LOST_FRAMES
    assert len(alone) < 30
    assert len(connected) == len(interrupted) - covered - begun_anew_after
    first, last = (np.searchsorted(interrupted.truth.stamps_ns, connected.stamps_ns[k]) for k in (0, -1))
    truth = interrupted.truth.T_world_body
    want = inverse(truth[first]) @ truth[last]
    got = inverse(connected.T_world_body[0]) @ connected.T_world_body[-1]
    assert np.linalg.norm(got[:3, 3] - want[:3, 3]) < 0.15
    assert angle_between(got[:3, :3], want[:3, :3]) < 0.05
