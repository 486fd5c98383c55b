"""Sensors of a recording beside the one that is tracked: which are fused, and at which poses."""

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.frames import Scan
from mapper.core.geometry import apply, inverse, transform
from mapper.pipeline.build import build
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import chained
from mapper.sources.ros.encode_ros import camera_info_message, cloud_message, image_message, imu_message
from tests.support.recordings import COLOR, DEPTH, shots, transforms, write
from tests.support.tum_logs import FIRST_NS, PERIOD_NS

T_OPTICAL_LIDAR = transform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.05, -0.1, 0.02])
)
MOUNTED = transforms(("optical", "lidar", T_OPTICAL_LIDAR))
POINTS = np.random.default_rng(1).uniform(-9.0, 9.0, (200, 3)).astype(np.float32)


def clouds(topic="/lidar/points", frame="lidar", *, count=6, offset_ns=0):
    stamps_ns = [FIRST_NS + i * PERIOD_NS + offset_ns for i in range(count)]
    return [cloud_message(topic, Scan(stamp_ns, POINTS), frame=frame) for stamp_ns in stamps_ns]


def opened(path, messages, **topics):
    return open_source(write(path, messages), SourceConfig.model_validate({"topics": topics}))


def test_a_lidar_beside_a_camera_keeps_its_frame_and_gets_stamps_of_its_own(tmp_path):
    log = opened(tmp_path / "a.mcap", [MOUNTED, *shots(), *clouds()])
    (beside,) = log.beside
    assert (log.sensor, beside.log.sensor, len(beside.log)) == ("rgbd", "lidar", 6)
    np.testing.assert_allclose(beside.T_body_sensor, T_OPTICAL_LIDAR, atol=1e-9)
    assert not np.isin(beside.log.stamps_ns, log.stamps_ns).any()
    assert np.abs(beside.log.stamps_ns - log.stamps_ns).max() <= 1
    np.testing.assert_allclose(beside.log[0].scan().points_body, POINTS, atol=1e-6)


def test_a_camera_beside_a_lidar_and_strided_sensors(tmp_path):
    messages = [MOUNTED, *shots(), *clouds()]
    log = opened(tmp_path / "a.mcap", messages, points="/lidar/points")
    (beside,) = log.beside
    assert (log.sensor, beside.log.sensor) == ("lidar", "rgbd")
    np.testing.assert_allclose(beside.T_body_sensor, inverse(T_OPTICAL_LIDAR), atol=1e-9)
    strided = open_source(tmp_path / "a.mcap", SourceConfig(stride=2))
    assert [len(one.log) for one in strided.beside] == [3]
    both = chained(log, log)
    assert [len(one.log) for one in both.beside] == [6, 6]
    assert both.beside[1].log.stamps_ns[0] > log.stamps_ns[-1]


@pytest.mark.parametrize(
    "others",
    [
        [MOUNTED, *clouds("/lidar/points_filtered")],  # computed
        clouds(),  # tf does not say where
        [MOUNTED, *clouds(frame="optical")],  # of the depth image
        [transforms(("base_link", "optical", np.eye(4))), *clouds(frame="base_link")],  # a copy
        [MOUNTED, *clouds(frame="map")],
        [
            transforms(("optical", "lidar", T_OPTICAL_LIDAR), topic="/tf", stamp_ns=FIRST_NS),
            transforms(("optical", "lidar", np.eye(4)), topic="/tf", stamp_ns=FIRST_NS + PERIOD_NS),
            *clouds(),
        ],  # it turns
    ],
    ids=["computed", "no tf", "depth image", "base", "map", "moving"],
)
def test_what_is_no_other_sensor_or_of_unknown_pose_is_not_fused_but_named(tmp_path, others):
    log = opened(tmp_path / "a.mcap", [*shots(), *others])
    assert log.beside == []
    assert any("/lidar/points" in sentence and "not" in sentence for sentence in log.sentences)


def test_packets_of_a_driver_whose_clouds_are_used_are_not_fused_again(tmp_path):
    mounted = transforms(*(("optical", frame, T_OPTICAL_LIDAR) for frame in ("lidar", "sensor", "rear")))
    packets = [*clouds("/lidar/packets", "sensor"), *clouds("/rear/packets", "rear")]
    log = opened(tmp_path / "a.mcap", [mounted, *shots(), *clouds(), *packets])
    assert [one.log.name for one in log.beside] == ["/lidar/points", "/rear/packets"]


def test_sensors_that_stay_on_the_body_are_told_used_or_not(tmp_path):
    T_lidar_imu = transform(np.eye(3), np.array([0.0, 0.0, -0.04]))
    tf = [
        transforms(("optical", "lidar", T_OPTICAL_LIDAR), ("lidar", "imu", T_lidar_imu)),
        transforms(("optical", "map", np.eye(4)), ("optical", "unseen", np.eye(4))),
    ]
    at_rest = imu_message(FIRST_NS, "/imu", rates_radps=None, acceleration_mps2=np.full(3, 5.7), frame="/imu")
    others = [at_rest, *clouds(), *clouds("/global", "map"), *clouds("/far", "nowhere")]
    log = opened(tmp_path / "a.mcap", [*tf, *shots(), *others], others="unused")
    expected = {"imu": T_OPTICAL_LIDAR @ T_lidar_imu, "lidar": T_OPTICAL_LIDAR}
    assert {(one.frame, one.parent) for one in log.sensors} == {(name, "optical") for name in expected}
    for one in log.sensors:
        np.testing.assert_allclose(one.T_parent_sensor, expected[one.frame], atol=1e-12)


@pytest.fixture(scope="module")
def mixed(desk_log, tmp_path_factory):
    """Return the desk's recording with a LiDAR that sees a wall 7 m behind the camera, and the wall."""
    log = open_source(desk_log)
    across, up = (axis.ravel() for axis in np.meshgrid(*[np.arange(-1.0, 1.0, 0.03)] * 2))
    T_world_first = log.truth.at(int(log.stamps_ns[0]))
    wall_world = apply(T_world_first, np.column_stack([across, up, np.full_like(up, -7.0)]))
    messages = [MOUNTED]
    for entry in log.entries():
        frame, units = entry.load(), {"encoding": "16UC1", "frame": "optical"}
        stamp_ns = frame.stamp_ns
        messages += [
            image_message(stamp_ns, COLOR, frame.rgb, encoding="rgb8", frame="optical"),
            image_message(stamp_ns, DEPTH, np.rint(frame.depth_m * 1e3).astype(np.uint16), **units),
            camera_info_message(stamp_ns, "/cam/color/camera_info", frame.camera, frame="optical"),
        ]
        seen_ns = stamp_ns + PERIOD_NS // 2
        if log.truth.stamps_ns[0] <= seen_ns <= log.truth.stamps_ns[-1]:
            T_lidar_world = inverse(log.truth.at(seen_ns) @ T_OPTICAL_LIDAR)
            points = apply(T_lidar_world, wall_world).astype(np.float32)
            messages.append(cloud_message("/lidar/points", Scan(seen_ns, points), frame="lidar"))
    path = write(tmp_path_factory.mktemp("mixed") / "mixed.mcap", messages)
    return path, apply(inverse(T_world_first), wall_world)


@pytest.fixture(scope="module")
def runs(mixed, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")

    def built(others):
        config = load_config(None, [f"source.topics.others={others}", "mcap.frame_times=false"])
        return build(open_source(mixed[0], config.source), config, out / others)

    return {others: built(others) for others in ("fused", "unused")}


def test_the_map_has_what_only_the_other_sensor_saw(mixed, runs):
    around_m = 0.05 * np.array(list(np.ndindex(3, 3, 3))) - 0.05
    occupied = {}
    for others, run in runs.items():
        wall_map = apply(run.trajectory[0], mixed[1])
        near = [run.octree.are_occupied(wall_map + shift_m) for shift_m in around_m]
        occupied[others] = np.any(near, axis=0).mean()
    assert occupied["fused"] > 0.97
    assert occupied["unused"] == 0.0
    np.testing.assert_array_equal(
        runs["fused"].trajectory.T_world_body, runs["unused"].trajectory.T_world_body
    )


def test_fusing_again_casts_nothing_and_changes_nothing(runs):
    before = (runs["fused"].path / "map.octree").read_bytes()
    again = runs["fused"].fuse()
    assert (again.path / "map.octree").read_bytes() == before
