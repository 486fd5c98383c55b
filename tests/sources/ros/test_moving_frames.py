"""Frames of tf that move: clouds are turned into the robot's by it, and a path in it may be the truth."""

import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import Scan
from mapper.core.geometry import apply, exp, inverse
from mapper.sources import open_source
from mapper.sources.config import SourceConfig, TopicsConfig
from mapper.sources.ros.encode_ros import cloud_message, imu_message, odometry_message
from tests.support.recordings import shots, transforms, write
from tests.support.tum_logs import FIRST_NS, PERIOD_NS

STAMPS_NS = [FIRST_NS + i * PERIOD_NS for i in range(6)]
POINTS_BASE = np.random.default_rng(5).uniform(-9.0, 9.0, (40, 3))


def drive(stamp_ns):
    """T_map_base of a robot that drives a curve."""
    seconds = (stamp_ns - FIRST_NS) / 1e9
    return exp(np.array([0.0, 0.0, 0.4 * seconds]), np.array([1.5 * seconds + 20.0, 3.0, 0.5]))


def pan(stamp_ns):
    """T_base_lidar of a LiDAR on a pan unit."""
    return exp(np.array([0.0, 0.0, 2.0 * (stamp_ns - FIRST_NS) / 1e9 - 0.3]), np.array([0.2, 0.0, 1.0]))


def moving(pose, *names):
    """Messages of tf at 50 Hz, from before the first cloud until after the last."""
    times = range(FIRST_NS - 40_000_000, STAMPS_NS[-1] + 40_000_000, 20_000_000)
    return [transforms((*names, pose(t)), topic="/tf", stamp_ns=t) for t in times]


def clouds(T_frame_base, *, frame, with_times=False):
    times_s = np.linspace(0.0, 0.1, len(POINTS_BASE), dtype=np.float32) if with_times else None
    return [
        cloud_message(
            "/points",
            Scan(t, apply(T_frame_base(t), POINTS_BASE).astype(np.float32), times_s=times_s),
            frame=frame,
        )
        for t in STAMPS_NS
    ]


def on_map(**options):
    return clouds(drive, frame="map", **options)


def on_mast():
    return clouds(lambda t: inverse(pan(t)), frame="lidar")


def imu(stamp_ns, acceleration_mps2, *, frame):
    return imu_message(stamp_ns, "/imu", rates_radps=None, acceleration_mps2=acceleration_mps2, frame=frame)


def opened(path, messages, **config):
    return open_source(write(path, messages), SourceConfig(**config))


def all_near(scans, points_body):
    for scan in scans:
        np.testing.assert_allclose(scan.points_body, points_body, atol=2e-3)


def test_clouds_of_the_map_are_turned_back_into_the_robot_s_base(tmp_path):
    messages = [*moving(drive, "map", "base_link"), *on_map(with_times=True)]
    log = opened(tmp_path / "a.mcap", messages)
    scans = list(log)
    all_near(scans, POINTS_BASE)
    np.testing.assert_array_equal([scan.origin_body for scan in scans], np.zeros((6, 3)))
    assert all(scan.times_s is None for scan in scans)
    assert sum("base_link" in note for note in log.notes) == 1


def test_without_a_base_they_are_turned_into_what_moves_in_their_frame(tmp_path):
    messages = [transforms(("body", "imu", np.eye(4))), *moving(drive, "map", "body"), *on_map()]
    all_near(opened(tmp_path / "a.mcap", messages), POINTS_BASE)


@pytest.mark.parametrize(
    "frame", ["map", "robot1/odom", "odom_combined", "Map", "lio_map", "utm", "odom_frame", "map1"]
)
@pytest.mark.parametrize("tf", [[], [transforms(("map", "base_link", np.eye(4)))]])
def test_where_nothing_moves_in_tf_clouds_of_a_frame_that_stays_are_refused(tmp_path, frame, tf):
    with pytest.raises(SourceError, match=f"frame {frame}, which stays"):
        opened(tmp_path / "a.mcap", [*tf, *clouds(drive, frame=frame)])


def test_a_pan_unit_is_where_tf_has_it_at_each_scan_s_time(tmp_path):
    log = opened(tmp_path / "a.mcap", [*moving(pan, "base_link", "lidar"), *on_mast()])
    all_near(log, POINTS_BASE)
    np.testing.assert_allclose(log[3].origin_body, pan(STAMPS_NS[3])[:3, 3], atol=1e-3)
    np.testing.assert_array_equal(log.T_base_body, np.eye(4))
    own = opened(tmp_path / "b.mcap", [*moving(pan, "base_link", "lidar"), *on_mast()], body_frame="lidar")
    assert own.T_base_body is None
    np.testing.assert_allclose(own.T_body_base.T_world_body, [inverse(pan(t)) for t in STAMPS_NS], atol=1e-3)
    assert not any("base.tum" in note for note in own.sentences)
    undated = [
        transforms(("base_link", "lidar", pan(tf.stamp_ns)), topic="/tf")._replace(stamp_ns=tf.stamp_ns)
        for tf in moving(pan, "base_link", "lidar")
    ]  # which have the times of recording
    all_near(opened(tmp_path / "c.mcap", [*undated, *on_mast()]), POINTS_BASE)


def test_what_is_recorded_of_the_base_is_led_to_a_moving_body(tmp_path):
    messages = [
        *moving(pan, "base_link", "lidar"),
        *on_mast(),
        *(odometry_message(t, "/odom", drive(t), frame="odom", child="base_link") for t in STAMPS_NS),
        *(imu(t, np.array([0.3, 0.1, 9.8]), frame="base_link") for t in STAMPS_NS),
    ]
    config = {"body_frame": "lidar", "topics": TopicsConfig(truth="/odom", wheels="/odom")}
    log = opened(tmp_path / "a.mcap", messages, **config)
    for poses in (log.truth, log.wheels):
        np.testing.assert_allclose(poses.T_world_body, [drive(t) @ pan(t) for t in STAMPS_NS], atol=2e-3)
    expected = [pan(t)[:3, :3].T @ [0.3, 0.1, 9.8] for t in STAMPS_NS]
    np.testing.assert_allclose(log.accelerations.acceleration_mps2, expected, atol=5e-3)


def test_a_scan_at_a_time_without_tf_is_left_out(tmp_path):
    tf = [message for message in moving(pan, "base_link", "lidar") if message.stamp_ns < STAMPS_NS[3]]
    log = opened(tmp_path / "a.mcap", [*tf, *on_mast()])
    with pytest.raises(FrameError, match="at that time"):
        log[4]
    all_near([log[0], log[2]], POINTS_BASE)


def test_readings_without_stamps_have_the_times_of_recording(tmp_path):
    readings = [imu(0, np.array([0.0, 0.0, 9.8]), frame="lidar") for _ in STAMPS_NS]
    poses = [odometry_message(0, "/odom", drive(t), frame="odom", child="lidar") for t in STAMPS_NS]
    dated = [
        m._replace(stamp_ns=t) for many in (readings, poses) for t, m in zip(STAMPS_NS, many, strict=True)
    ]
    messages = sorted([*on_mast(), *dated], key=lambda message: message.stamp_ns)
    log = opened(tmp_path / "a.mcap", messages, topics=TopicsConfig(truth="/odom"))
    assert log.accelerations.stamps_ns.tolist() == STAMPS_NS
    assert log.truth.stamps_ns.tolist() == STAMPS_NS


def test_stamps_of_another_clock_are_moved_by_the_times_of_recording(tmp_path):
    boot_ns = STAMPS_NS[0] - 5_000_000_000
    points = [apply(inverse(pan(t)), POINTS_BASE).astype(np.float32) for t in STAMPS_NS]
    scans = [
        cloud_message("/points", Scan(t - boot_ns, each), frame="lidar")._replace(stamp_ns=t)
        for t, each in zip(STAMPS_NS, points, strict=True)
    ]
    others = [
        *(odometry_message(t, "/odom", drive(t), frame="odom", child="base_link") for t in STAMPS_NS),
        *(imu(t, np.array([0.0, 0.0, 9.8]), frame="base_link") for t in STAMPS_NS),
    ]
    messages = sorted([*moving(pan, "base_link", "lidar"), *scans, *others], key=lambda one: one.stamp_ns)
    log = opened(tmp_path / "a.mcap", messages, topics=TopicsConfig(truth="/odom"))
    all_near(log, POINTS_BASE)
    expected = [t - boot_ns for t in STAMPS_NS]
    for stamps_ns in (log.stamps_ns, log.truth.stamps_ns, log.accelerations.stamps_ns):
        assert stamps_ns.tolist() == expected
    assert sum("clock" in note for note in log.notes) == 2


def test_a_body_that_stays_is_refused(tmp_path):
    messages = [*moving(drive, "map", "base_link"), *clouds(lambda _: np.eye(4), frame="base_link")]
    with pytest.raises(SourceError, match="want a frame of the robot: base_link"):
        opened(tmp_path / "a.mcap", messages, body_frame="map")


def test_of_several_robots_the_base_in_the_sensor_s_namespace_carries_it(tmp_path):
    bases = [("map", f"{robot}/base_link", np.eye(4)) for robot in "abc"]
    mounted = transforms(*bases, ("b/base_link", "b/lidar", pan(FIRST_NS)))
    scans = clouds(lambda t: inverse(pan(t)), frame="b/lidar")
    log = opened(tmp_path / "a.mcap", [mounted, *scans])
    assert log.base_frame == "b/base_link"
    np.testing.assert_allclose(log.T_base_body, pan(FIRST_NS), atol=1e-9)


def test_truth_is_taken_from_tf_on_request(tmp_path):
    T_marker_optical = pan(FIRST_NS)
    times = range(FIRST_NS - 40_000_000, STAMPS_NS[3] + 40_000_000, 10_000_000)
    T_world_marker = {t: exp(np.zeros(3), np.array([(t - FIRST_NS) / 1e9, 0.0, 0.0])) for t in times}
    messages = [
        transforms(("/marker", "/optical", T_marker_optical), topic="/tf", stamp_ns=FIRST_NS),
        *(transforms(("/world", "/marker", T), topic="/tf", stamp_ns=t) for t, T in T_world_marker.items()),
        *shots(4),
    ]
    without = open_source(write(tmp_path / "a.bag", messages))
    assert without.truth is None
    assert any("source.topics.truth=tf:world" in choice for choice in without.choices)

    def by(frame):
        return open_source(tmp_path / "a.bag", SourceConfig(topics=TopicsConfig(truth=f"tf:{frame}")))

    for frame in ("world", "/world"):
        truth = by(frame).truth
        assert truth.stamps_ns.tolist() == list(times)
        np.testing.assert_allclose(
            truth.T_world_body, [T @ T_marker_optical for T in T_world_marker.values()], atol=1e-9
        )
        assert not any("truth=tf" in choice for choice in by(frame).choices)
        assert list(by(frame).notes) == list(without.notes)  # which are possible causes of doubts
    for frame in ("marker", "map", ""):
        with pytest.raises(SourceError, match=r"does not move in .*: world$"):
            by(frame)


def test_joints_of_the_robot_and_its_wheels_are_not_offered_for_the_truth(tmp_path):
    joints = [transforms(("base_footprint", "base_link", np.eye(4))), *moving(pan, "base_link", "optical")]
    wheels = moving(drive, "odom", "base_footprint")
    for name, messages, offered in (
        ("joints", joints, None),
        ("wheels", [*joints, *wheels], None),
        ("truth", [*joints, *wheels, *moving(drive, "world", "odom")], "world"),
    ):
        log = opened(tmp_path / f"{name}.mcap", [*messages, *shots(4)])
        told = [choice for choice in log.choices if "topics.truth=" in choice]
        assert [choice.partition("topics.truth=tf:")[2].split()[0] for choice in told] == (
            [] if offered is None else [offered]
        )
