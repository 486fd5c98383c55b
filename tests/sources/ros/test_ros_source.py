"""Which topics are mapped, with which camera and where from; and what is done with the others."""

import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import PinholeCamera, Scan
from mapper.core.geometry import exp, inverse
from mapper.sources import open_source
from mapper.sources.config import CameraConfig, SourceConfig, TopicsConfig
from mapper.sources.image_files.reading import decode_depth_units
from mapper.sources.ros.encode_ros import (
    SerializedMessage,
    cloud_message,
    compressed_image_message,
    imu_message,
    odometry_message,
)
from mapper.sources.ros.typestore import make_header, make_message, serialize
from mapper.sources.writers import write_log
from tests.support.recordings import (
    CAMERA,
    COLOR,
    DEPTH,
    camera_info,
    changed,
    image,
    shots,
    transforms,
    write,
)
from tests.support.tum_logs import FIRST_NS, PERIOD_NS, picture

RVL = "16UC1; compressedDepth rvl"
INFO = "/cam/color/camera_info"
T_BASE_LIDAR = exp(np.array([0.0, 0.0, 1.5]), np.array([0.2, 0.0, 1.1]))


def cloud(stamp_ns, topic="/velodyne_points", n=20):
    points = np.random.default_rng(stamp_ns % 1000).uniform(-9.0, 9.0, (n, 3)).astype(np.float32)
    return cloud_message(topic, Scan(stamp_ns, points), frame="lidar")


def odometry(stamp_ns, T, *, child="base_link", topic="/odom"):
    return odometry_message(stamp_ns, topic, T, frame="odom", child=child)


def imu(stamp_ns, acceleration, *, rates=None, frame="imu", topic="/imu/data"):
    return imu_message(
        stamp_ns,
        topic,
        rates_radps=None if rates is None else np.array(rates),
        acceleration_mps2=np.array(acceleration),
        frame=frame,
    )


def opened(path, messages, **config):
    return open_source(write(path, messages), SourceConfig(**config))


def stamps(n):
    return [FIRST_NS + i * PERIOD_NS for i in range(n)]


def test_images_go_before_clouds_unless_clouds_are_asked_for(tmp_path):
    messages = [*shots(3), *(cloud(t) for t in stamps(4))]
    source = opened(tmp_path / "a.mcap", messages)
    assert (source.sensor, len(source)) == ("rgbd", 3)
    assert any("source.topics.points=/velodyne_points" in choice for choice in source.choices)
    source = open_source(tmp_path / "a.mcap", SourceConfig(topics=TopicsConfig(points="/velodyne_points")))
    assert (source.sensor, len(source)) == ("lidar", 4)
    assert source.choices[0] == "point clouds /velodyne_points"
    assert all("tf does not say where optical is on lidar" in one for one in source.choices[1:])


def test_clouds_of_a_second_lidar_are_said_to_be_left_out(tmp_path):
    messages = [cloud(t, topic) for t in stamps(4) for topic in ("/rear/points", "/front/points")]
    source = opened(tmp_path / "a.mcap", messages)
    assert len(source.sentences) == 2
    assert source.notes[0].endswith(": /rear/points")
    chosen = open_source(tmp_path / "a.mcap", SourceConfig(topics=TopicsConfig(points="/rear/points")))
    assert chosen.choices == ["point clouds /rear/points"]


def test_topics_that_are_not_used_are_named_with_the_reason(tmp_path):
    fix = make_message(
        "sensor_msgs/msg/NavSatFix",
        header=make_header(FIRST_NS, "gps"),
        status=make_message("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        latitude=0.0, longitude=0.0, altitude=1.0, position_covariance=np.zeros(9),
        position_covariance_type=0,
    )  # fmt: skip
    text = make_message("std_msgs/msg/String", data="x")
    rgb, _ = picture(0)
    messages = [
        *(cloud(t) for t in stamps(3)),
        cloud(FIRST_NS, "/map_cloud"),
        *(image(t, "/fish/image_raw", rgb, "rgb8") for t in stamps(3)),
        *(imu(t, [0.0, 0.0, 9.8]) for t in stamps(3)),
        *(imu(t, [0.0, 0.0, 9.8], topic="/imu/other/data") for t in stamps(3)),
        *(imu(t, [0.0, 0.0, 0.0], topic="/gyro") for t in stamps(3)),
        *(odometry(t, np.eye(4)) for t in stamps(3)),
        *(odometry(t, np.eye(4), topic="/vio") for t in stamps(3)),
        SerializedMessage(FIRST_NS, "/fix", "sensor_msgs/msg/NavSatFix", serialize(fix)),
        SerializedMessage(FIRST_NS, "/nmea/fix", "sensor_msgs/msg/NavSatFix", serialize(fix)),
        SerializedMessage(FIRST_NS, "/rosout", "std_msgs/msg/String", serialize(text)),
        transforms(("lidar", "imu", np.eye(4))),
    ]
    notes = opened(tmp_path / "a.mcap", messages).notes
    named = [note.rpartition(": ")[2] for note in notes]
    assert sorted(named) == [
        "/fish/image_raw",
        "/gyro (0)",
        "/imu/other/data",
        "/map_cloud",
        "/nmea/fix",
        "/odom, /vio",
        "1 of 1 messages have no place (NaN, zeros, or no degrees); left out",
        "its angular velocities are all 0 or no numbers; not used",
        "no fixes",
    ]
    damaged = [m._replace(cdr=m.cdr[:30]) if m.topic == "/fish/image_raw" else m for m in messages]
    assert any("/fish/image_raw: a damaged" in note for note in opened(tmp_path / "b.mcap", damaged).notes)
    both = opened(tmp_path / "c.mcap", [*messages, *shots(3)])
    assert any(note.endswith(": /fish/image_raw") for note in both.notes)


def test_the_likeliest_of_several_topics_is_taken_and_another_can_be_chosen(tmp_path):
    messages = []
    for i, t in enumerate(stamps(3)):
        rgb, units = picture(i)
        messages += [
            image(t, "/cam/infra1/image_rect_raw", rgb[:, :, 0], "mono8"),
            image(t, "/cam/depth/image_rect_raw", units + 1, "16UC1"),
            image(t, "/cam/aligned_depth_to_color/image_raw", units, "16UC1"),
            image(t, "/cam/color/image_raw", rgb, "rgb8"),
            camera_info(t),
        ]
    source = opened(tmp_path / "a.mcap", messages)
    assert source.choices[0].startswith(
        "colour /cam/color/image_raw, depth /cam/aligned_depth_to_color/image_raw;"
    )
    topics = TopicsConfig(color="/cam/infra1/image_rect_raw", depth="/cam/depth/image_rect_raw")
    config = SourceConfig(topics=topics, camera=CameraConfig(fx_px=50, fy_px=50, cx_px=32, cy_px=24))
    chosen = open_source(tmp_path / "a.mcap", config)
    frame = next(chosen.entries()).load()
    assert frame.image.ndim == 2
    assert frame.camera == PinholeCamera(64, 48, 50, 50, 32, 24)
    assert chosen.choices[0] == "colour /cam/infra1/image_rect_raw, depth /cam/depth/image_rect_raw"


@pytest.mark.parametrize(
    ("topics", "why"),
    [
        ({"color": "/nowhere"}, r"a.mcap: source.topics.color=/nowhere is not there; topics for that: /cam"),
        ({"imu": COLOR}, r"source.topics.imu=/cam/color/image_raw is of type sensor_msgs/msg/Image"),
    ],
)
def test_a_choice_that_cannot_be_is_refused(tmp_path, topics, why):
    with pytest.raises(SourceError, match=why):
        opened(tmp_path / "a.mcap", shots(2), topics=TopicsConfig(**topics))


NO_DEPTH = "nothing to map: colour images /cam/color/image_raw, but neither depth images"


def only(topic):
    return [message for message in shots(3) if message.topic == topic]


@pytest.mark.parametrize(
    ("messages", "why"),
    [
        (only(COLOR), NO_DEPTH),
        (only(DEPTH), "nothing to map: depth images /cam/aligned_depth/image_raw, but neither colour images"),
        (only(INFO), r"neither images with depth nor several point clouds, only /cam/color/c"),
        ([], "no message of it can be read"),
        (
            [message for message in shots(2) if message.topic != INFO],
            r"no camera info for /cam/color/image_raw; .*source.camera.fx_px",
        ),
        (
            [
                *only(COLOR),
                *(
                    compressed_image_message(
                        t, f"{DEPTH}/compressedDepth", bytes(40), format_=RVL, frame="optical"
                    )
                    for t in stamps(3)
                ),
            ],
            r"neither depth .*/cam/aligned_depth/image_raw/compressedDepth: RVL of 0",
        ),
        (
            [m._replace(cdr=m.cdr[:40]) if m.topic == COLOR else m for m in shots(3)],
            "first messages can be read: /cam/color/image_raw: a damaged m",
        ),
    ],
)
def test_what_is_missing_is_named(tmp_path, messages, why):
    with pytest.raises(SourceError, match=why):
        opened(tmp_path / "a.mcap", messages)


def test_depth_that_is_not_registered_is_refused(tmp_path):
    other = PinholeCamera(64, 48, 45.0, 45.0, 31.5, 23.5)
    messages = [*shots(2), camera_info(FIRST_NS, "/cam/aligned_depth/camera_info", other)]
    why = r"aligned_depth/image_raw \(64×48 px, focal length 45.0 px\) is not registered to /cam/color"
    with pytest.raises(SourceError, match=why):
        opened(tmp_path / "a.mcap", messages)
    cropped = [image(FIRST_NS, DEPTH, np.ones((20, 32), np.uint16), "16UC1"), *shots(1)[1:]]
    why = r"/cam/aligned_depth/image_raw: colour has 64×48 px and depth 32×20, which is another aspect ratio"
    with pytest.raises(SourceError, match=why):
        opened(tmp_path / "b.mcap", cropped)


def test_depth_of_another_size_is_brought_to_colours(tmp_path):
    units = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
    small = [image(FIRST_NS, DEPTH, units, "16UC1"), *(one for one in shots(1) if one.topic != DEPTH)]
    of_depth = camera_info(FIRST_NS, "/cam/aligned_depth/camera_info", CAMERA.resized(32, 24))
    source = opened(tmp_path / "a.mcap", [*small, of_depth])
    assert source[0].camera == CAMERA
    np.testing.assert_array_equal(source[0].depth_m, units.repeat(2, 0).repeat(2, 1) / np.float32(1000))
    assert any("depth is resized to 64×48" in note for note in source.notes)
    other = camera_info(FIRST_NS, "/cam/aligned_depth/camera_info", CAMERA)  # a copy of colour's
    wide = PinholeCamera(32, 24, 20.0, 20.0, 15.5, 11.5)
    assert opened(tmp_path / "b.mcap", [*small, other])[0].camera == CAMERA
    why = r"\(32×24 px, focal length 20.0 px\) is not registered to /cam/color/image_raw .focal length 30.0"
    with pytest.raises(SourceError, match=why):
        opened(tmp_path / "c.mcap", [*small, camera_info(FIRST_NS, "/cam/aligned_depth/camera_info", wide)])


def test_depth_that_tf_places_elsewhere_is_refused_unless_it_is_called_registered(tmp_path):
    beside = np.eye(4)
    beside[0, 3] = 0.015
    taken = "depth in frame d is taken to be registered to colour in optical"

    def with_depth_of(topic, T):
        depths = [image(t, topic, picture(i)[1], "16UC1", frame="d") for i, t in enumerate(stamps(3))]
        return [transforms(("optical", "d", T)), *depths, *(one for one in shots(3) if one.topic != DEPTH)]

    why = r"/cam/depth/image is not registered to /cam/color/image_raw, 15 mm beside it by tf"
    with pytest.raises(SourceError, match=why):
        opened(tmp_path / "a.mcap", with_depth_of("/cam/depth/image", beside))
    assert taken in opened(tmp_path / "b.mcap", with_depth_of("/cam/depth_registered/image", beside)).notes
    assert taken in opened(tmp_path / "c.mcap", with_depth_of("/cam/depth/image", np.eye(4))).notes


def test_depth_of_one_camera_is_not_paired_with_colour_of_another(tmp_path):
    messages = []
    for i, t in enumerate(stamps(6)):
        rgb, units = picture(i)
        for camera, without in (("a", "depth"), ("b", "color")):  # each would be taken for its number alone
            one = [
                image(t, f"/{camera}/color/image_raw", rgb, "rgb8", frame=f"{camera}_optical"),
                image(t, f"/{camera}/depth/image_raw", units, "16UC1", frame=f"{camera}_optical"),
                camera_info(t, f"/{camera}/color/camera_info"),
            ]
            messages += [message for message in one if i or without not in message.topic]
    source = opened(tmp_path / "a.mcap", messages)
    assert source.choices[0].startswith("colour /a/color/image_raw, depth /a/depth/image_raw;")
    config = SourceConfig(topics=TopicsConfig(color="/b/color/image_raw"))
    source = open_source(tmp_path / "a.mcap", config)
    assert source.choices[0].startswith("colour /b/color/image_raw, depth /b/depth/image_raw;")


@pytest.mark.parametrize("factor", [None, 1.0, 1000.0])
def test_units_of_depth_can_be_set(tmp_path, factor):
    camera = {"fx_px": 60, "fy_px": 60, "cx_px": 32, "cy_px": 24}
    of_16_bits = opened(tmp_path / "b.mcap", shots(1), camera=CameraConfig(**camera, depth_factor=5000))
    np.testing.assert_array_equal(of_16_bits[0].depth_m, picture(0)[1].astype(np.float32) / np.float32(5000))

    depth_m = np.linspace(0.5, 4.0, 48 * 64, dtype=np.float32).reshape(48, 64)
    stored = depth_m * np.float32(factor or 1.0)
    messages = [image(FIRST_NS, DEPTH, stored, "32FC1") if m.topic == DEPTH else m for m in shots(1)]
    log = opened(tmp_path / "a.mcap", messages, camera=CameraConfig(**camera, depth_factor=factor))
    entry = next(log.entries())
    np.testing.assert_allclose(entry.load().depth_m, depth_m, rtol=1e-6)
    assert entry.files.recorded_units_per_m == (factor or 1.0)
    written_m = decode_depth_units(entry.files.depth.read_bytes(), "png") / entry.files.depth_units_per_m
    np.testing.assert_allclose(written_m, depth_m, atol=1.1e-4)


@pytest.mark.parametrize("name", ["a.mcap", "a.bag", "a"])
def test_truth_is_led_to_the_sensor_by_tf(tmp_path, name):
    poses = [exp(np.array([0.0, 0.0, 0.1 * i]), np.array([float(i), 0.0, 0.0])) for i in range(4)]
    messages = [
        transforms(("odom", "base_link", np.eye(4)), topic="/tf"),
        transforms(("base_link", "lidar", T_BASE_LIDAR)),
        *(cloud(t) for t in stamps(4)),
        *(odometry(t, T) for t, T in zip(stamps(4), poses, strict=True)),
    ]
    assert opened(tmp_path / name, messages).truth is None
    topics = TopicsConfig(truth="/odom")
    source = open_source(tmp_path / name, SourceConfig(topics=topics))
    np.testing.assert_allclose(source.truth.T_world_body, [T @ T_BASE_LIDAR for T in poses], atol=1e-12)
    based = open_source(tmp_path / name, SourceConfig(topics=topics, body_frame="base_link"))
    np.testing.assert_allclose(based.truth.T_world_body, poses, atol=1e-12)
    own, moved = (next(log.entries()).load() for log in (source, based))
    expected = own.points_body @ T_BASE_LIDAR[:3, :3].T + T_BASE_LIDAR[:3, 3]
    np.testing.assert_allclose(moved.points_body, expected, atol=1e-5)
    with pytest.raises(SourceError, match=r"body_frame=wheel: .* frames: base_link, lidar, odom"):
        open_source(tmp_path / name, SourceConfig(body_frame="wheel"))


def test_wheels_must_be_asked_for_and_are_led_to_the_sensor(tmp_path):
    poses = [exp(np.array([0.0, 0.0, 0.1 * i]), np.array([float(i), 0.0, 0.0])) for i in range(4)]
    wheels = [odometry(t, T) for t, T in zip(stamps(4), poses, strict=True)]
    tied = [transforms(("base_link", "lidar", T_BASE_LIDAR)), *(cloud(t) for t in stamps(4)), *wheels]
    assert opened(tmp_path / "a.mcap", tied).wheels is None
    asked = SourceConfig(topics=TopicsConfig(wheels="/odom"))
    source = open_source(tmp_path / "a.mcap", asked)
    np.testing.assert_allclose(source.wheels.T_world_body, [T @ T_BASE_LIDAR for T in poses], atol=1e-12)
    assert source.truth is None
    opened(tmp_path / "b.mcap", [*shots(4), *wheels])
    source = open_source(tmp_path / "b.mcap", asked)
    np.testing.assert_allclose(source.wheels.T_world_body[0, :3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    assert any("/odom: tf does not tie base_link to optical" in note for note in source.notes)


def test_accelerations_are_told_in_the_body_where_tf_ties_the_two(tmp_path):
    R = T_BASE_LIDAR[:3, :3]
    messages = [
        transforms(("base_link", "lidar", T_BASE_LIDAR), ("base_link", "imu", np.eye(4))),
        *(cloud(t) for t in stamps(3)),
        *(imu(t, [0.1, 0.2, 9.8]) for t in stamps(3)),
        *(imu(t, [0.0, 0.0, 0.0], topic="/gyro") for t in stamps(9)),  # a gyroscope alone
    ]
    told = opened(tmp_path / "a.mcap", messages).accelerations
    assert told.stamps_ns.tolist() == stamps(3)
    np.testing.assert_allclose(told.acceleration_mps2, np.tile([0.1, 0.2, 9.8] @ R, (3, 1)), atol=1e-12)
    place_body = inverse(T_BASE_LIDAR)[:3, 3]
    np.testing.assert_allclose(told.place_body, place_body, atol=1e-12)
    assert write_log(open_source(tmp_path / "a.mcap"), tmp_path / "again.mcap", kind="mcap") == []
    again = open_source(tmp_path / "again.mcap").accelerations
    assert again.are_axes_stated
    np.testing.assert_allclose(again.acceleration_mps2, told.acceleration_mps2, atol=1e-12)
    np.testing.assert_allclose(again.place_body, place_body, atol=1e-12)
    without = [message for message in messages if "tf" not in message.topic]
    told = opened(tmp_path / "b.mcap", without).accelerations
    np.testing.assert_array_equal(told.acceleration_mps2, np.tile([0.1, 0.2, 9.8], (3, 1)))


def test_no_acceleration_of_a_long_recording_is_left_out(tmp_path):
    times_ns = range(FIRST_NS, FIRST_NS + 25_000 * 1_000_000, 1_000_000)
    messages = [*(cloud(t) for t in stamps(3)), *(imu(t, [0.0, 0.0, 9.8]) for t in times_ns)]
    assert len(opened(tmp_path / "a.mcap", messages).accelerations.stamps_ns) == 25_000


def test_angular_velocities_come_from_the_topic_that_has_them(tmp_path):
    messages = [
        transforms(("base_link", "lidar", T_BASE_LIDAR), ("base_link", "imu", np.eye(4))),
        *(cloud(t) for t in stamps(3)),
        *(imu(t, [0.0, 0.0, 9.8], topic="/accel") for t in stamps(3)),
        *(imu(t, [0.0, 0.0, 0.0], rates=[0.1, 0.2, -0.3 * t / 1e18], topic="/gyro") for t in stamps(9)),
    ]
    log = opened(tmp_path / "a.mcap", messages)
    assert log.accelerations.stamps_ns.tolist() == stamps(3)
    assert (log.gyroscope.name, log.gyroscope.stamps_ns.tolist()) == ("/gyro", stamps(9))
    np.testing.assert_allclose(log.gyroscope.rates_radps[:, 2], [-0.3 * t / 1e18 for t in stamps(9)])
    np.testing.assert_allclose(log.gyroscope.R_body_imu, T_BASE_LIDAR[:3, :3].T, atol=1e-12)
    assert opened(tmp_path / "b.mcap", messages[:-9]).gyroscope is None


@pytest.mark.parametrize("P", [{}, {"p": np.zeros(12)}], ids=["by P", "by K"])
def test_a_camera_of_rectified_images_has_no_distortion(tmp_path, P):
    t = stamps(1)[0]
    rgb, units = picture(0)
    messages = [
        image(t, "/cam/image_rect_color", rgb, "rgb8"),
        image(t, "/cam/depth", units, "16UC1"),
        changed(camera_info(t, "/cam/camera_info"), **P),
    ]
    camera = next(opened(tmp_path / "a.mcap", messages).entries()).load().camera
    assert camera == PinholeCamera(64, 48, CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px)


def test_points_of_a_camera_are_told_to_look_forward(tmp_path):
    points = np.random.default_rng(0).uniform(1.0, 5.0, (20, 3)).astype(np.float32)
    messages = [cloud_message("/points", Scan(t, points), frame="depth_optical") for t in stamps(2)]
    notes = opened(tmp_path / "a.mcap", messages).notes
    assert notes[-1].startswith("points are in depth_optical, whose z looks forward")


def test_a_damaged_first_image_file_does_not_hide_the_log(tiny_tum_log, tmp_path):
    source = open_source(tiny_tum_log(4, ending=".jpg"))
    file = next(source.entries()).files.colour
    file.write_bytes(file.read_bytes()[:100])
    write_log(open_source(source.path), tmp_path / "log.mcap", kind="mcap")
    again = list(open_source(tmp_path / "log.mcap").entries())
    with pytest.raises(FrameError, match="truncated JPEG"):
        again[0].load()
    assert again[1].load().image.shape == (48, 64, 3)


def test_a_body_frame_is_refused_where_there_is_no_tf(tiny_tum_log, tmp_path):
    logs = [write(tmp_path / name, shots(3)) for name in ("log.mcap", "log.bag")]
    for i in range(2):
        (tmp_path / "scans").mkdir(exist_ok=True)
        np.save(tmp_path / f"scans/{i}.npy", np.random.default_rng(i).normal(0.0, 9.0, (20, 3)))
    why = r"body_frame=base_link: (.* no frames|only a recording's tf)"
    for log in (*logs, tiny_tum_log(2), tmp_path / "scans"):
        with pytest.raises(SourceError, match=why):
            open_source(log, SourceConfig(body_frame="base_link"))
