"""Values in recordings that contradict their labels, or that nothing can be made of."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.frames import PinholeCamera, Scan
from mapper.sources import open_source
from mapper.sources.calibration_file import calibration_text
from mapper.sources.config import SourceConfig, TopicsConfig
from mapper.sources.inspection import inspect_log
from mapper.sources.ros.encode_ros import SerializedMessage, cloud_message
from mapper.sources.ros.typestore import serialize, typestore
from tests.support.recordings import CAMERA, COLOR, DEPTH, camera_info, changed, image, shots, write
from tests.support.tum_logs import FIRST_NS, PERIOD_NS, picture

STAMPS_NS = [FIRST_NS + i * PERIOD_NS for i in range(3)]


def clouds(points, stamps_ns=STAMPS_NS, **fields):
    return [cloud_message("/points", Scan(t, points, **fields), frame="lidar") for t in stamps_ns]


def test_a_calibration_of_another_camera_that_is_chosen_skips_no_check(tmp_path):
    other = replace(CAMERA, fx_px=40.0, fy_px=40.0)
    depth_info = camera_info(FIRST_NS, "/cam/aligned_depth/camera_info", other)
    config = SourceConfig(topics=TopicsConfig(camera_info="/cam/aligned_depth/camera_info"))
    with pytest.raises(SourceError, match=r"focal length 40\.0 px\) is not registered"):
        open_source(write(tmp_path / "a.mcap", [*shots(2), depth_info]), config)
    same = camera_info(FIRST_NS, "/other/camera_info", CAMERA)
    config = SourceConfig(topics=TopicsConfig(camera_info="/other/camera_info"))
    log = open_source(write(tmp_path / "b.mcap", [*shots(2), same]), config)
    assert sum("/other/camera_info" in note for note in log.notes) == 1


def test_intrinsics_of_a_file_beside_stand_in_for_those_that_were_not_recorded(tmp_path):
    other = PinholeCamera(64, 48, 50.0, 51.0, 31.5, 23.5)
    (tmp_path / "calibration.toml").write_text(calibration_text(other, depth_units_per_m=5000.0))
    assert open_source(write(tmp_path / "a.mcap", shots(2)))[0].camera == CAMERA
    images = [message for message in shots(2) if not message.topic.endswith("camera_info")]
    log = open_source(write(tmp_path / "b.mcap", images))
    assert log[0].camera == other
    np.testing.assert_array_equal(log[0].depth_m, picture(0)[1] / np.float32(5000))
    assert sum("calibration.toml" in note for note in log.notes) == 1


@pytest.mark.parametrize("value", [0.0, 0.05])
def test_a_field_of_times_that_holds_none_is_noted(tmp_path, value):
    points = np.random.default_rng(3).uniform(-9.0, 9.0, (20, 3)).astype(np.float32)
    messages = clouds(points, times_s=np.full(20, value, np.float32))
    log = open_source(write(tmp_path / "a.mcap", messages), SourceConfig())
    assert sum("no times" in note for note in log.notes) == 1
    assert log[0].times_s is None


def renamed(message, names):
    """The cloud with other names of its fields."""
    fields = typestore("cdr").deserialize_cdr(message.cdr, message.type).fields
    return changed(
        message, fields=[replace(field, name=names.get(field.name, field.name)) for field in fields]
    )


def test_fields_of_other_names(tmp_path):
    points = np.random.default_rng(3).uniform(-9.0, 9.0, (20, 3)).astype(np.float32)
    messages = clouds(points, times_s=np.linspace(0.0, 0.09, 20, dtype=np.float32))
    known = {
        field.name for field in typestore("cdr").deserialize_cdr(messages[0].cdr, messages[0].type).fields
    }
    (times,) = known & {"t", "time"}
    for k, name in enumerate(("time_sec", "tag")):
        names = {"x": "X", "y": "Y", "z": "Z", times: name}
        log = open_source(write(tmp_path / f"{k}.mcap", [renamed(one, names) for one in messages]))
        np.testing.assert_array_equal(log[0].points_body, points)
        assert (log[0].times_s is None) == (k == 1)
        assert [name in choice for choice in log.choices if "times" in choice] == [True] * (k == 0)


def test_clouds_in_millimetres_are_refused_and_the_setting_reads_them(tmp_path):
    points = np.random.default_rng(3).uniform(-9000.0, 9000.0, (2000, 3)).astype(np.float32)
    path = write(tmp_path / "a.mcap", clouds(points))
    assert "source.cloud_scale=0.001" in inspect_log(path, SourceConfig()).problem
    found = inspect_log(path, SourceConfig(cloud_scale=0.001))
    assert found.problem is None
    (scan, *_) = open_source(path, SourceConfig(cloud_scale=0.001))
    np.testing.assert_allclose(scan.points_body, points / 1000.0, rtol=1e-6)


def test_messages_of_one_stamp_and_one_time_of_recording_are_refused(tmp_path):
    messages = clouds(np.ones((20, 3), np.float32), [FIRST_NS] * 4)
    assert "all 4 messages" in inspect_log(write(tmp_path / "a.mcap", messages), SourceConfig()).problem


def test_images_without_pixels_and_depth_without_values_are_refused(tmp_path):
    none, zero = np.zeros((1, 0, 3), np.uint8), np.zeros((48, 64), np.uint16)
    for name, topic, made in (("a", COLOR, (none, "rgb8")), ("b", DEPTH, (zero, "16UC1"))):
        messages = [image(m.stamp_ns, topic, *made) if m.topic == topic else m for m in shots(3)]
        assert inspect_log(write(tmp_path / f"{name}.mcap", messages), SourceConfig()).problem is not None


def sensor_message(type_, stamp_ns, topic, **fields):
    store = typestore("cdr")
    types, second = store.types, 10**9
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // second, nanosec=stamp_ns % second)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar")
    made = types[type_](header=header, **fields)
    return SerializedMessage(stamp_ns, topic, type_, serialize(made))


def test_clouds_of_the_older_message_are_read_with_their_channels(tmp_path):
    types = typestore("cdr").types
    points = np.random.default_rng(3).uniform(-9.0, 9.0, (20, 3)).astype(np.float32)
    times_s = np.linspace(0.0, 0.09, 20, dtype=np.float32)
    channels = [
        types["sensor_msgs/msg/ChannelFloat32"](name=name, values=values)
        for name, values in (("time", times_s), ("intensity", times_s + 1), ("short", times_s[:3]))
    ]
    messages = [
        sensor_message(
            "sensor_msgs/msg/PointCloud",
            stamp_ns,
            "/cloud",
            points=[types["geometry_msgs/msg/Point32"](*point) for point in points.tolist()],
            channels=channels,
        )
        for stamp_ns in STAMPS_NS
    ]
    for name in ("a.mcap", "a.bag"):
        log = open_source(write(tmp_path / name, messages))
        np.testing.assert_array_equal(log[0].points_body, points)
        np.testing.assert_allclose(log[0].times_s, times_s, atol=1e-7)
        np.testing.assert_array_equal(log[0].intensities, times_s + 1)
        assert sum("short" in note for note in log.notes) == 1


def test_of_several_echoes_the_nearest_is_read(tmp_path):
    types = typestore("cdr").types
    echoes = [[2.0, 5.0], [], [3.0]] * 20
    beams = [types["sensor_msgs/msg/LaserEcho"](echoes=np.array(one, np.float32)) for one in echoes]
    limits = {"angle_min": -1.0, "angle_max": 1.0, "angle_increment": 2.0 / 59, "range_min": 0.1}
    limits |= {"range_max": 30.0, "time_increment": 0.0, "scan_time": 0.1}
    messages = [
        sensor_message(
            "sensor_msgs/msg/MultiEchoLaserScan", stamp_ns, "/echoes", ranges=beams, intensities=[], **limits
        )
        for stamp_ns in STAMPS_NS
    ]
    log = open_source(write(tmp_path / "a.mcap", messages))
    assert log.sensor == "lidar-2d"
    distances_m = np.linalg.norm(log[0].points_body, axis=1)
    np.testing.assert_allclose(distances_m, [2.0, 3.0] * 20, rtol=1e-6)


@pytest.mark.parametrize("ending", ["mcap", "bag"])
def test_endings_in_capitals_are_read(tmp_path, ending):
    path = write(tmp_path / f"a.{ending}", shots(2))
    path.rename(tmp_path / f"A.{ending.upper()}")
    for opened in (tmp_path / f"A.{ending.upper()}", tmp_path):
        assert len(open_source(opened)) == 2
