"""Topics that are not used: another camera's calibration, types that are not read, accelerations."""

import numpy as np
import pytest
from mcap.writer import Writer

from mapper.core.errors import SourceError
from mapper.core.frames import Scan
from mapper.sources import open_source
from mapper.sources.ros.encode_ros import cloud_message, imu_message
from tests.support.recordings import COLOR, DEPTH, add_messages, image, shots, transforms, write
from tests.support.tum_logs import FIRST_NS, PERIOD_NS

STAMPS_NS = [FIRST_NS + i * PERIOD_NS for i in range(4)]
POINTS = np.random.default_rng(1).uniform(-9.0, 9.0, (20, 3)).astype(np.float32)


def cloud(stamp_ns):
    return cloud_message("/points", Scan(stamp_ns, POINTS), frame="lidar")


def imu(stamp_ns, length, *, rate=0.1):
    up = np.array([0.0, 0.0, length])
    rates = np.array([rate, 0.0, 0.0])
    return imu_message(stamp_ns, "/imu", rates_radps=rates, acceleration_mps2=up, frame="imu")


def write_mcap(path, messages):
    """Write messages of any types, without their definitions."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        add_messages(writer, messages)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "type_",
    [
        "hesai_ros_driver/msg/UdpFrame",
        "pandar_msgs/msg/PandarScan",
        "rslidar_msgs/msg/rslidarScan",
        "rslidar_msg/msg/RslidarPacket",
        "nebula_msgs/msg/NebulaPackets",
    ],
)
def test_packets_that_are_not_decoded_are_named_with_the_remedy(tmp_path, type_):
    packets = [cloud(t)._replace(topic="/lidar_packets", type=type_) for t in STAMPS_NS]
    with pytest.raises(SourceError, match=rf"driver.*PointCloud2.*/lidar_packets \({type_}\)"):
        open_source(write_mcap(tmp_path / "a.mcap", packets))
    log = open_source(write_mcap(tmp_path / "b.mcap", [*packets, *(cloud(t) for t in STAMPS_NS)]))
    assert sum(type_ in note and "driver" in note for note in log.notes) == 1


def opened(path, messages):
    return open_source(write(path, messages))


def test_the_depth_camera_s_own_calibration_is_not_colour_s(tmp_path):
    raw = "/cam/depth/image_raw"
    messages = [one._replace(topic=raw) if one.topic == DEPTH else one for one in shots(2)]
    of_depth = [
        one._replace(topic="/cam/depth/camera_info") if "info" in one.topic else one for one in messages
    ]
    with pytest.raises(SourceError, match=r"no camera info for .*/cam/depth/camera_info"):
        opened(tmp_path / "a.mcap", of_depth)
    assert len(opened(tmp_path / "b.mcap", messages)) == 2


JOINTS, SHALLOW = "sensor_msgs/msg/JointState", np.zeros((48, 64), np.uint8)


@pytest.mark.parametrize(
    ("topic", "changed", "why"),
    [
        (COLOR, lambda one: one._replace(topic=f"{COLOR}/h264", type=JOINTS), f"{COLOR}/h264 .{JOINTS}"),
        (DEPTH, lambda one: image(one.stamp_ns, DEPTH, SHALLOW, "mono8"), f"{DEPTH} is 'mono8', not depth"),
    ],
)
def test_topics_that_cannot_be_read_are_named_where_nothing_can_be_mapped(tmp_path, topic, changed, why):
    messages = [changed(one) if one.topic == topic else one for one in shots(2)]
    with pytest.raises(SourceError, match=why):
        opened(tmp_path / "a.mcap", messages)


@pytest.mark.parametrize(
    ("length", "rate", "is_used", "is_noted"),
    [
        (100.0, 0.1, (False, True), "/imu (100)"),
        (0.0, 0.1, (False, True), ""),
        (9.8, 0.1, (True, True), ""),
        (9.8, 0.0, (True, False), "angular velocities"),
    ],
)
def test_readings_that_are_not_used_beside_the_others_of_their_unit_are_named(
    tmp_path, length, rate, is_used, is_noted
):
    messages = [one for t in STAMPS_NS for one in (imu(t, length, rate=rate), cloud(t))]
    log = opened(tmp_path / "a.mcap", messages)
    assert (log.accelerations is not None, log.gyroscope is not None) == is_used
    for words in ("/imu (100)", "angular velocities"):
        assert sum(words in note for note in log.notes) == (words == is_noted)


@pytest.mark.parametrize(("unit", "tolerance"), [(1.0, 1e-4), (1000.0, 1e-4), (980.665, 0.02)])
def test_accelerations_in_g_mg_or_cm_become_metres(tmp_path, unit, tolerance):
    log = opened(tmp_path / "a.mcap", [one for t in STAMPS_NS for one in (imu(t, unit), cloud(t))])
    lengths = np.linalg.norm(log.accelerations.acceleration_mps2, axis=1)
    np.testing.assert_allclose(lengths, 9.80665, rtol=tolerance)
    assert sum("accelerations" in note for note in log.notes) == 1


def test_readings_that_are_no_numbers_are_left_out_and_counted(tmp_path):
    readings = [
        imu(t, np.nan if i == 1 else 9.8, rate=np.inf if i > 1 else 0.1) for i, t in enumerate(STAMPS_NS)
    ]
    log = opened(tmp_path / "a.mcap", [*readings, *(cloud(t) for t in STAMPS_NS)])
    assert (len(log.accelerations.stamps_ns), len(log.gyroscope)) == (3, 2)
    counts = [note.split(": ")[1].split(" of 4")[0] for note in log.notes if "not finite" in note]
    assert sorted(counts) == ["1", "2"]


@pytest.mark.parametrize(("x_m", "noted"), [(0.3, 0), (np.nan, 1)])
def test_a_mounting_of_no_numbers_is_noted(tmp_path, x_m, noted):
    T_base_lidar = np.eye(4)
    T_base_lidar[0, 3] = x_m
    messages = [transforms(("base_link", "lidar", T_base_lidar)), *(cloud(t) for t in STAMPS_NS)]
    log = opened(tmp_path / "a.mcap", messages)
    assert sum("base_link → lidar" in note for note in log.notes) == noted
    assert (log.T_base_body is None) == bool(noted)


@pytest.mark.parametrize(("is_in_tf", "expected"), [(True, "/sensors/imu"), (False, "/imu")])
def test_of_two_imus_one_whose_frame_is_in_tf_is_chosen_and_named_with_the_setting(
    tmp_path, is_in_tf, expected
):
    other = [one._replace(topic="/sensors/imu") for one in (imu(t, 9.8) for t in STAMPS_NS)]
    apart = imu_message(
        FIRST_NS, "/imu", rates_radps=np.ones(3), acceleration_mps2=np.array([0.0, 9.8, 0.0]), frame="apart"
    )
    messages = [*other, apart, *(cloud(t) for t in STAMPS_NS)]
    tied = [transforms(("lidar", "imu", np.eye(4)))] if is_in_tf else []
    log = opened(tmp_path / "a.mcap", [*messages, *tied])
    assert len(log.accelerations.stamps_ns) == (len(STAMPS_NS) if is_in_tf else 1)
    assert sum(expected in one and "source.topics.imu=" in one for one in log.choices) == 1


def test_a_first_cloud_in_a_frame_of_its_own_does_not_leave_out_the_others(tmp_path):
    astray = cloud_message("/points", Scan(FIRST_NS - PERIOD_NS, POINTS), frame="")
    log = opened(tmp_path / "a.mcap", [astray, *(cloud(t) for t in STAMPS_NS)])
    assert (len(log[1:]), log.body_frame) == (len(STAMPS_NS), "lidar")
    assert len(log[1].points_body)
    assert sum("1 of 5 clouds" in note for note in log.notes) == 1


@pytest.mark.parametrize(
    ("points", "names", "chosen"),
    [
        ("/points", ["/camera/imu", "/imu/data"], "/imu/data"),
        ("/ouster/points", ["/imu", "/ouster/imu"], "/ouster/imu"),
    ],
)
def test_of_imus_that_tf_does_not_know_one_beside_the_lidar_is_chosen(tmp_path, points, names, chosen):
    clouds = [cloud(t)._replace(topic=points) for t in STAMPS_NS]
    readings = [imu(t, 9.81)._replace(topic=name) for name in names for t in STAMPS_NS]
    log = opened(tmp_path / "a.mcap", [*clouds, *readings])
    assert sum(f"accelerations {chosen}," in choice for choice in log.choices) == 1


def test_images_of_disparity_are_no_depth(tmp_path):
    disparity = [one._replace(topic="/cam/disparity") if one.topic == DEPTH else one for one in shots(3)]
    with pytest.raises(SourceError, match=r"/cam/disparity is called no depth; .*baseline"):
        opened(tmp_path / "a.mcap", disparity)
    confidence = [one._replace(topic="/cam/confidence_rgb") for one in shots(3) if one.topic == DEPTH]
    log = opened(tmp_path / "b.mcap", [*shots(3), *confidence])
    assert sum(f"colour {COLOR}, depth {DEPTH}" in choice for choice in log.choices) == 1
