"""Spikes of a path: found in both directions of time, and nothing else that moves fast."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapper.core.geometry import exp, rotation_log, transform
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.pipeline.trajectory_spikes import with_doubtful_spikes
from mapper.sensing.gyroscope import Gyroscope

HOW = Diagnostics(100, 50, 40, 0.5, "px", "map")
STEP_NS = 66_666_667


def walk(offs_m=(), offs_rad=(), *, count=120, seed=0, step_ns=STEP_NS):
    """Results of a shaking walk; frames are off by some metres across it, or turned by some radians."""
    rng = np.random.default_rng(seed)
    off_m, off_rad = dict(offs_m), dict(offs_rad)
    tracks = []
    for k in range(count):
        turn = np.array([0.0, 0.0, 0.3 * np.sin(0.2 * k) + off_rad.get(k, 0.0)])
        place = np.array([0.06 * k, 0.05 * np.sin(0.7 * k) + off_m.get(k, 0.0), 1.0])
        T = exp(turn + rng.normal(0.0, 1e-3, 3), place + rng.normal(0.0, 2e-3, 3))
        tracks.append(
            FrameResult(
                stamp_ns=k * step_ns, node=k // 10, T_node_body=np.eye(4), T_world_body=T,
                is_keyframe=k % 10 == 0, diagnostics=HOW, covariance=1e-6 * np.eye(6),
            )
        )  # fmt: skip
    return tracks


def doubted(tracks, gyroscope=None):
    return [k for k, track in enumerate(with_doubtful_spikes(tracks, gyroscope)) if track.doubts]


def test_a_walk_has_none():
    assert doubted(walk()) == []
    assert doubted(walk(count=4)) == []
    assert doubted([]) == []


@pytest.mark.parametrize("frames", [[50], [59, 60, 61], [70, 71, 72, 73, 74]])
def test_a_step_aside_and_back_is_a_spike_keyframes_included(frames):
    tracks = walk(dict.fromkeys(frames, 0.25).items())
    assert doubted(tracks) == frames
    changed = with_doubtful_spikes(tracks)
    assert {track.doubts[0].kind for track in changed if track.doubts} == {"jump"}
    loose = [k for k in frames if not tracks[k].is_keyframe]
    assert all(np.sqrt(changed[k].covariance[3, 3]) > 0.2 for k in loose)


def test_one_turned_frame_is_a_spike():
    assert doubted(walk(offs_rad={33: np.radians(9.6)}.items())) == [33]


def test_turns_are_measured_against_the_gyroscope():
    """What it measured is the sensor's own motion; what it did not is none."""
    still = walk()
    jerked = [
        replace(a, T_world_body=transform(b.T_world_body[:3, :3], a.T_world_body[:3, 3]))
        for a, b in zip(still, walk(offs_rad={33: np.radians(9.6)}.items()), strict=True)
    ]

    assert doubted(jerked, gyroscope_of(jerked)) == doubted(still, gyroscope_of(still)) == []
    assert doubted(jerked, gyroscope_of(still)) == doubted(still, gyroscope_of(jerked)) == [33]
    assert doubted(jerked) == [33]


def gyroscope_of(tracks):
    """The constant angular velocities that turn each frame into the next, read six times between them."""
    R = [track.T_world_body[:3, :3] for track in tracks]
    stamps_ns = np.arange(6 * (len(R) - 1)) * (STEP_NS // 6) + STEP_NS // 12
    rates = [6e9 / STEP_NS * rotation_log(a.T @ b) / 6 for a, b in pairwise(R)]
    return Gyroscope("imu", stamps_ns, np.repeat(rates, 6, axis=0), is_of_body=True)


@pytest.mark.parametrize(("step_ns", "are_spikes"), [(STEP_NS, True), (500_000_000, False)])
def test_what_a_sensor_can_be_carried_along_is_none(step_ns, are_spikes):
    """Half a metre and 10° aside in three frames are a spike at 15 Hz, and a swerve at 2 Hz."""
    frames = [50, 51, 52]
    aside = walk(dict.fromkeys(frames, 0.5).items(), step_ns=step_ns)
    turned = walk(offs_rad=dict.fromkeys(frames, np.radians(10.0)).items(), step_ns=step_ns)

    assert doubted(aside) == doubted(turned) == (frames if are_spikes else [])


@pytest.mark.parametrize(("frames", "off_m"), [(range(50, 120), 0.25), (range(0, 120, 2), 0.15)])
def test_a_step_that_stays_and_what_the_log_does_all_the_time_are_none(frames, off_m):
    assert doubted(walk(dict.fromkeys(frames, off_m).items())) == []
