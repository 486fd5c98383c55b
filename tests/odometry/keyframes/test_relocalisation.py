"""Relocalisation after a loss: a known place is recognised, an unknown one begins a sub-map."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import angle_between, inverse
from mapper.graph.components import components
from mapper.graph.model import PoseGraph
from mapper.odometry.config import IsvdOdometryConfig, LocalMapConfig, PnpConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.keyframes.local_search import least_by_chance
from mapper.simulation.config import SynthConfig
from mapper.simulation.source import CameraSimulator
from tests.support.desk_frames import blank

RATE_HZ = 15.0
ISVD = IsvdOdometryConfig()
BOTH = pytest.mark.parametrize("config", [LocalMapConfig(), PnpConfig()], ids=lambda config: config.kind)


@pytest.fixture(scope="module")
def source():
    """One and a half turns on the spot."""
    return CameraSimulator(
        SynthConfig(
            path="spin",
            duration_s=7.0,
            frame_rate_hz=RATE_HZ,
            max_yaw_rate_rad_s=1.9,
            width_px=320,
            height_px=240,
            texture_px_per_m=96,
        )
    ).log()


@pytest.fixture(scope="module")
def frames(source):
    return [entry.load(colour=False) for entry in source.entries()]


def seconds(start_s, end_s):
    return slice(round(start_s * RATE_HZ), round(end_s * RATE_HZ))


def tracked(frames, odometry):
    return [odometry.track(odometry.observe(frame)) for frame in frames]


def graph_of(tracks, odometry):
    graph = PoseGraph()
    for track in tracks:
        if track.is_keyframe:
            graph.add_node(track.node, track.stamp_ns, track.T_world_body)
    graph.add_factors(odometry.finish())
    return graph


@BOTH
def test_a_known_place_is_recognised_in_its_first_frame_and_its_landmarks_are_shared(source, frames, config):
    dark = seconds(4.5, 5.5)
    log = [*frames[: dark.start], *map(blank, frames[dark]), *frames[dark.stop :]]
    odometry = build_frame_odometry(config)

    tracks = tracked(log, odometry)

    assert [i for i, t in enumerate(tracks) if t.node is None] == list(range(dark.start, dark.stop))
    back = tracks[dark.stop]
    assert back.diagnostics.method == "relocalised"
    found_by = back.links[0].i if back.is_keyframe else back.node
    assert found_by < tracks[dark.start - 1].node // 2  # a keyframe of the turn before
    T_truth = inverse(source.truth.T_world_body[0]) @ source.truth.T_world_body[dark.stop]
    miss = inverse(T_truth) @ back.T_world_body
    assert np.linalg.norm(miss[:3, 3]) < 0.08
    assert angle_between(miss[:3, :3], np.eye(3)) < 0.04
    graph = graph_of(tracks, odometry)
    assert len(components(graph)) == 1
    assert any(factor.j - factor.i > 10 for factor in graph.factors)


@BOTH
def test_an_unknown_place_begins_a_sub_map(frames, config, monkeypatch):
    monkeypatch.setattr("mapper.odometry.keyframes.tracking.MOST_LOST_FRAMES", 4)
    before, elsewhere = frames[seconds(0.0, 1.0)], frames[seconds(2.3, 3.3)]
    odometry = build_frame_odometry(config)

    tracks = tracked([*before, *elsewhere], odometry)

    last, after = tracks[len(before) - 1], tracks[len(before) :]
    assert [t.node is None for t in after] == [True] * 4 + [False] * (len(after) - 4)
    first = after[4]
    assert first.is_keyframe
    assert first.diagnostics.method == "start"
    assert not first.links
    assert not first.factors
    assert np.allclose(first.T_world_body, last.T_world_body)
    assert all(t.node >= first.node for t in after[4:])
    parts = components(graph_of(tracks, odometry))
    assert [part[0] for part in parts] == [0, first.node]


def test_darkness_is_no_place(frames, monkeypatch):
    """Frames without features never begin a map, however many they are."""
    monkeypatch.setattr("mapper.odometry.keyframes.tracking.MOST_LOST_FRAMES", 2)
    odometry = build_frame_odometry(LocalMapConfig())
    tracks = tracked([*frames[:5], *map(blank, frames[5:9]), *frames[9:12]], odometry)
    assert all(t.node is None for t in tracks[5:9])
    assert tracks[9].diagnostics.method.startswith("relocalised")


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_weak_poses_that_of_more_inliers_counts(frames, order, monkeypatch):
    """No pose has enough inliers here, so each keyframe is tried, in any order."""
    monkeypatch.setattr("mapper.odometry.keyframes.relocalizer.WEAK_INLIERS", 10_000)
    odometry = build_frame_odometry(LocalMapConfig())
    tracked(frames[:12], odometry)
    relocalizer, observation = odometry._tracking._relocalizer, odometry.observe(frames[12])
    keyframes = range(len(odometry._map.keyframes))[::order]
    alone = [relocalizer.best_among([k], observation, method="alone") for k in keyframes]

    best = relocalizer.best_among(keyframes, observation, method="all")

    assert sum(tracked_pose is not None for tracked_pose in alone) > 1
    assert best.inliers == max(tracked_pose.inliers for tracked_pose in alone if tracked_pose is not None)


class CarriedOff:
    """A motion check by which the body was carried to another place at some time."""

    def __init__(self, when_ns: int) -> None:
        self._when_ns = when_ns

    def contradiction(self, _T_begin_end, begin_ns: int, end_ns: int) -> str:
        return "carried off" if begin_ns <= self._when_ns < end_ns else ""


@BOTH
def test_a_place_that_only_looks_known_begins_a_sub_map(frames, config):
    """After the darkness the very same room is seen, but the wheels say that it is another one."""
    dark = seconds(4.5, 5.5)
    log = [*frames[: dark.start], *map(blank, frames[dark]), *frames[dark.stop :][:8]]
    odometry = build_frame_odometry(config, CarriedOff(frames[dark.start].stamp_ns))

    tracks = tracked(log, odometry)

    back = next(track for track in tracks[dark.stop :] if track.node is not None)
    assert back.diagnostics.method == "start"
    assert tracks.index(back) - dark.stop <= 1  # at once, instead of after MOST_LOST_FRAMES
    assert len(components(graph_of(tracks, odometry))) == 2


@BOTH
def test_after_a_gap_of_the_log_looks_do_not_decide_alone(frames, config):
    """No frame was lost, but two seconds are missing, in which the wheels drove elsewhere."""
    before = frames[seconds(0.0, 1.0)]
    after = [replace(frame, stamp_ns=frame.stamp_ns + 2_000_000_000) for frame in frames[seconds(0.5, 1.0)]]
    fooled, warned = (
        tracked([*before, *after], build_frame_odometry(config, check))
        for check in (None, CarriedOff(before[-1].stamp_ns))
    )
    assert fooled[len(before)].node is not None
    assert fooled[len(before)].diagnostics.method != "start"
    assert any(track.diagnostics.method == "start" for track in warned[len(before) :])


@pytest.mark.parametrize("stride", [4, 5])
def test_images_that_overlap_by_half_are_all_tracked(source, frames, stride):
    """They are up to 29° or 36° apart, and 63° wide."""
    tracks = tracked(frames[::stride], build_frame_odometry(LocalMapConfig()))
    assert all(track.node is not None for track in tracks)
    assert sum(track.diagnostics.method == "start" for track in tracks) == 1
    truth = inverse(source.truth.T_world_body[0]) @ source.truth.T_world_body[::stride]
    misses = [inverse(T) @ track.T_world_body for T, track in zip(truth, tracks, strict=True)]
    assert max(np.linalg.norm(miss[:3, 3]) for miss in misses) < 0.08


def test_more_landmarks_have_to_agree_where_more_are_in_view():
    counts = [least_by_chance(visible) for visible in (0, 100, 1000)]
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert 20 < counts[2] < 60  # of 1000, of which 20 agree by chance


@BOTH
def test_the_next_room_is_not_tracked_with_the_landmarks_of_one_alike(frames, config):
    """Once a sub-map has begun, no keyframe of the other room becomes a frame's reference."""
    before = frames[seconds(0.0, 1.0)]
    after = [replace(frame, stamp_ns=frame.stamp_ns + 4_000_000_000) for frame in before]
    odometry = build_frame_odometry(config, CarriedOff(before[-1].stamp_ns))
    tracks = tracked([*before, *after], odometry)
    first = next(track.node for track in tracks[len(before) :] if track.node is not None)
    assert all(track.node >= first for track in tracks[len(before) :] if track.node is not None)
    assert len(components(graph_of(tracks, odometry))) == 2


def test_isvd_stays_lost_rather_than_in_another_room(frames):
    before = frames[seconds(0.0, 0.5)]
    after = [replace(frame, stamp_ns=frame.stamp_ns + 4_000_000_000) for frame in before]
    fooled, warned = (
        tracked([*before, *after], build_frame_odometry(ISVD, check))
        for check in (None, CarriedOff(before[-1].stamp_ns))
    )
    assert all(track.node is not None for track in fooled)
    assert all(track.node is None for track in warned[len(before) :])
