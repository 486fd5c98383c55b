"""Wheel odometry alone: no frame is read for its pose, and walls stand where they are."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.deskew import twist_at
from mapper.core.errors import ConfigError, TrackingError
from mapper.core.geometry import angle_between, inverse
from mapper.core.timebase import NS_PER_S
from mapper.evaluators.metrics.occupancy import assess_by_distance, check_metrics
from mapper.features.frame_view import ImageView, ScanView
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.odometry.config import WheelsOdometryConfig
from mapper.odometry.factory import build_odometry
from mapper.pipeline.track import track_log
from mapper.pipeline.tracking_result import refuse_a_fragment
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT
from mapper.simulation import CameraSimulator, make_scene, write_tum_log
from mapper.simulation.config import SynthConfig, SynthWheelsConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.sources import open_source
from mapper.sources.multi_session_log import chained
from tests.support.logs import CountedReads, changed_frames
from tests.support.paths import CONFIGS
from tests.support.wheeled_worlds import EXACT, FLAT, STREET_ON_WHEELS


@pytest.fixture(scope="module")
def scene():
    return make_scene(FLAT)


@pytest.fixture(scope="module")
def flat(scene):
    return CameraSimulator(FLAT, scene).log()


def by_wheels(*overrides):
    return load_config(None, ["odometry.kind=wheels", "loops.kind=none", *overrides])


def wheels_with(source, keep):
    """A log whose wheels were read only where ``keep`` says, seconds after the start."""
    since_s = (source.wheels.stamps_ns - source.stamps_ns[0]) / NS_PER_S
    kept = keep(since_s)
    thinned = replace(
        source.wheels,
        stamps_ns=source.wheels.stamps_ns[kept],
        T_world_body=source.wheels.T_world_body[kept],
    )
    return replace(source, wheels=thinned)


def test_no_frame_is_read_and_every_one_lies_where_it_was_taken(flat):
    watched = CountedReads(flat)
    tracking = track_log(watched.log, by_wheels(), progress=SILENT)
    assert watched.reads == []
    path, truth = tracking.trajectory(), flat.truth
    T_truth_world = truth.T_world_body[0]
    np.testing.assert_array_equal(path.stamps_ns, truth.stamps_ns)
    np.testing.assert_allclose(T_truth_world @ path.T_world_body, truth.T_world_body, atol=2e-3)
    assert 10 < len(tracking.graph.T_world_node) < 40
    origins = [factor.origin for factor in tracking.graph.factors]
    assert origins == ["odometry"] * (len(tracking.graph.T_world_node) - 1)


def test_walls_stand_where_they_are(flat, scene):
    octree = OctreeMap(OctreeConfig())
    path = track_log(flat, by_wheels(), progress=SILENT).trajectory()
    scans = ordered_map(lambda entry: entry.scan(), flat.entries(), workers=2)
    for scan, T_world_body in zip(scans, path.T_world_body, strict=True):
        octree.insert(scan, flat.truth.T_world_body[0] @ T_world_body)
    for metric in check_metrics(assess_by_distance(octree, scene.boxes.signed_distance_m)):
        assert metric.value > (0.995 if "precision" in metric.name else 0.95), metric.name


def test_wheels_of_another_size_and_distance_stretch_the_path_and_its_turns(flat, scene):
    wrong = FLAT.model_copy(update={"wheels": SynthWheelsConfig(path_sigma=0.1, turn_sigma=0.1)})
    one, again = (CameraSimulator(wrong, scene).log().wheels for _ in range(2))
    np.testing.assert_array_equal(one.T_world_body, again.T_world_body)
    longer = one.path_length_m / flat.wheels.path_length_m
    assert abs(longer - 1.0) > 0.005
    turned, true = (
        sum(angle_between(a[:3, :3], b[:3, :3]) for a, b in zip(T[::10], T[10::10], strict=False))
        for T in (one.T_world_body, flat.wheels.T_world_body)
    )
    assert abs(turned / true - 1.0) > 0.005
    np.testing.assert_allclose(one.positions_world[:, 2], one.positions_world[0, 2], atol=1e-9)


def test_frames_without_a_reading_are_lost_and_the_path_goes_on_after_a_gap(flat):
    log = wheels_with(flat, lambda s: (s < 3.0) | ((s > 5.0) & (s < 7.0)))
    tracking = track_log(log, by_wheels(), progress=SILENT)
    lost = {
        (track.stamp_ns - flat.stamps_ns[0]) / NS_PER_S: track.diagnostics.method
        for track in tracking.tracks
        if track.node is None
    }
    assert {round(s, 2) for s in lost} == {round(k / 6.0, 2) for k in (*range(18, 31), *range(42, 49))}
    assert {how for s, how in lost.items() if s < 6.0} == {"lost in a gap of the wheels' readings"}
    assert {how for s, how in lost.items() if s > 6.0} == {"lost outside the wheels' readings"}
    path, truth = tracking.trajectory(), flat.truth
    estimated, true = inverse(path.T_world_body[0]) @ path.T_world_body[-1], inverse(truth.T_world_body[0])
    np.testing.assert_allclose(estimated, true @ truth.T_world_body[41], atol=2e-3)


def test_readings_of_another_time_are_named_as_what_is_wrong(flat):
    config = by_wheels()
    tracking = track_log(wheels_with(flat, lambda s: s > 7.9), config, progress=SILENT)
    with pytest.raises(TrackingError, match=r"only \d of 49 .* do the wheels' readings cover the frames'"):
        refuse_a_fragment(tracking, config, sensor="rgbd")


def test_a_log_without_wheels_is_refused_with_the_remedy(flat):
    log = replace(flat, wheels=None)
    with pytest.raises(ConfigError, match=r"has no wheel odometry; put wheels.txt .* source.topics.wheels="):
        track_log(log, by_wheels(), progress=SILENT)
    with pytest.raises(ConfigError, match=r"loops.kind=thesis looks from frames with many features, and"):
        track_log(flat, by_wheels("loops.kind=thesis"), progress=SILENT)


def test_loops_read_keyframes_only_and_skip_a_damaged_one(flat):
    watched = CountedReads(flat, damaged={0})
    tracking = track_log(watched.log, by_wheels("loops.kind=places"), progress=SILENT)
    nodes = set(tracking.graph.stamps_ns.values())
    keyframes = [k for k, entry in enumerate(flat.entries()) if entry.stamp_ns in nodes]
    assert watched.reads == keyframes
    assert len(tracking.placed) == len(flat)


@pytest.mark.parametrize("blank_frames", [(0,), range(6, 49), range(49)])
def test_keyframes_without_features_close_no_loop_and_end_nothing(flat, blank_frames):
    def without_texture(index, frame):
        return replace(frame, image=np.full_like(frame.image, 128)) if index in blank_frames else frame

    log = changed_frames(flat, without_texture)
    tracking = track_log(
        log, by_wheels("loops.kind=places", "loops.min_gap_s=0.1", "loops.min_gap_m=0.1"), progress=SILENT
    )
    assert len(tracking.placed) == len(flat)
    blank_ns = {flat.entry_at(i).stamp_ns for i in blank_frames}
    stamps_ns = tracking.graph.stamps_ns
    assert not any(
        {stamps_ns[loop.i], stamps_ns[loop.j]} & blank_ns
        for loop in tracking.loops
        if loop.verdict == "accepted"
    )


def test_keyframes_are_recognised_by_images_or_scans(flat):
    odometry = build_odometry(WheelsOdometryConfig(), flat.wheels)
    entry = next(flat.entries())
    seen = odometry.view(odometry.read(entry), odometry.track(entry).twist)
    assert isinstance(seen, ImageView)
    assert seen.is_orb
    street = LidarSimulator(STREET_ON_WHEELS).log()
    odometry = build_odometry(WheelsOdometryConfig(), street.wheels)
    entries = list(street.entries())
    track = [odometry.track(odometry.read(entry)) for entry in entries][10]
    true = twist_at(street.truth, 10)
    np.testing.assert_allclose(track.twist.translation_mps, true.translation_mps, atol=0.05)
    np.testing.assert_allclose(track.twist.rotation_radps, true.rotation_radps, atol=0.03)
    seen, still = odometry.view(entries[10], track.twist), odometry.view(entries[10])
    assert isinstance(seen, ScanView)
    assert len(seen.points_body) > 500
    moved_m = np.abs(seen.points_body.mean(axis=0) - still.points_body.mean(axis=0)).max()
    assert 0.05 < moved_m < 0.5


def test_a_synthetic_log_on_disk_has_its_wheels(tmp_path, scene):
    config = FLAT.model_copy(update={"duration_s": 0.4})
    write_tum_log(tmp_path / "log", config)
    wheels = open_source(tmp_path / "log").wheels
    log = CameraSimulator(config, scene).log()
    np.testing.assert_array_equal(wheels.stamps_ns, log.wheels.stamps_ns)
    np.testing.assert_allclose(wheels.T_world_body, log.wheels.T_world_body, atol=1e-6)
    assert wheels.stamps_ns[-1] >= log.stamps_ns[-1]


def test_a_camera_that_sways_up_and_down_has_no_wheels():
    with pytest.raises(ValueError, match="path desk moves up and down, which wheels do not; want loop or sp"):
        SynthConfig(path="desk", wheels=EXACT)


def test_a_later_session_keeps_its_wheels_on_the_common_clock(flat):
    source = chained(flat, flat)
    assert source.wheels is None
    session = source.sessions[-1].log
    shift_ns = source.sessions[1].shift_ns
    np.testing.assert_array_equal(session.wheels.stamps_ns, flat.wheels.stamps_ns + shift_ns)
    path = track_log(session, by_wheels(), progress=SILENT).trajectory()
    assert len(path) == len(flat)


def test_the_configuration_that_is_shipped_reads_no_frame(flat):
    config = load_config(CONFIGS / "wheels.toml")
    watched = CountedReads(flat)
    assert len(track_log(watched.log, config, progress=SILENT).placed) == len(flat)
    assert watched.reads == []
