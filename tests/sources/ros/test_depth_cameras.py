"""Recordings whose depth comes from a camera of its own: registered as they are read, or refused."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapper.core.errors import DataError, SourceError
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import apply, exp, inverse
from mapper.core.rotations import row_of_pose
from mapper.sources import open_source
from mapper.sources.config import CameraConfig, SourceConfig
from mapper.sources.inspection import inspect_log
from mapper.sources.ros.decode import decode
from mapper.sources.ros.encode_ros import SerializedMessage
from mapper.sources.ros.recording import Topic
from mapper.sources.ros.topic_ranks import is_called_rectified
from mapper.sources.ros.typestore import make_message, serialize
from mapper.sources.writers import write_log
from tests.support.depth_cameras import BESIDE, D435, extrinsics, write_unregistered
from tests.support.logs import changed_frames
from tests.support.recordings import CAMERA, COLOR, camera_info, changed, image, shots, transforms, write
from tests.support.tum_logs import FIRST_NS, picture

WIDE = PinholeCamera(106, 60, 53.0, 53.0, 52.4, 30.1)
DEPTH = "/cam/depth/image_rect_raw"


@pytest.fixture
def room(tiny_tum_log):
    """Frames of a tilted wall, and the same as a depth camera of its own measures them."""
    return open_source(tiny_tum_log(3))


def unregistered(depth_camera=WIDE, T=BESIDE, *, frame="depth_optical", topic=DEPTH, info=True):
    """RGB-D messages with depth of a wall, 2 m off, of another camera, whose place tf states."""
    T_color_depth = [transforms(("optical", frame, T))] if T is not None else []
    wall = np.full((depth_camera.height_px, depth_camera.width_px), 2000, np.uint16)
    messages = [message for message in shots(3) if "aligned" not in message.topic]
    messages += [image(one.stamp_ns, topic, wall, "16UC1", frame=frame) for one in shots(3)[1::3]]
    if info:
        messages.append(camera_info(FIRST_NS, topic.rpartition("/")[0] + "/camera_info", depth_camera))
    return [*T_color_depth, *messages]


def opened(path, messages, **config):
    return open_source(write(path, messages), SourceConfig(**config))


@pytest.mark.parametrize("source", ["tf", "topic"])
def test_depth_of_a_camera_beside_is_that_of_the_registered_log(tmp_path, room, source):
    write_unregistered(tmp_path / "bag", room, WIDE, BESIDE, stated_in=source)
    log = open_source(tmp_path / "bag")
    assert len(log) == len(room)
    for found, wanted in zip(log, room, strict=True):
        np.testing.assert_array_equal(found.image, wanted.image)
        assert found.camera == wanted.camera
        both = (found.depth_m > 0.0) & (wanted.depth_m > 0.0)
        assert both.sum() > 0.9 * (wanted.depth_m > 0.0).sum()
        # The wall is slanted by 4 mm a pixel of colour, and depth is in millimetres.
        assert np.abs(found.depth_m - wanted.depth_m)[both].max() < 0.02
        assert abs((found.depth_m - wanted.depth_m)[both].mean()) < 0.001
        assert found.depth_delay_s == pytest.approx(wanted.depth_delay_s, abs=1e-9)
    origin = "(tf)" if source == "tf" else "(/camera/extrinsics/depth_to_color)"
    notes = [note for note in inspect_log(tmp_path / "bag", SourceConfig()).log.notes if "registered" in note]
    assert len(notes) == 1
    assert "15.0 mm" in notes[0]
    assert origin in notes[0]


def test_scans_have_all_returns_of_the_depth_camera_along_its_own_rays(tmp_path):
    entry = opened(tmp_path / "a.mcap", unregistered()).entry_at(0)
    scan, frame = entry.scan(), entry.load()
    assert frame.is_depth_moved
    assert len(scan.points_body) == WIDE.width_px * WIDE.height_px > np.count_nonzero(frame.depth_m)
    np.testing.assert_allclose(scan.origin_body, BESIDE[:3, 3], atol=1e-6)
    in_depth = apply(inverse(BESIDE), scan.points_body.astype(np.float64))
    np.testing.assert_allclose(in_depth[:, 2], 2.0, atol=1e-4)
    pixels = np.stack(np.meshgrid(np.arange(106), np.arange(60)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(WIDE.project(in_depth), pixels, atol=1e-2)


def test_a_converted_log_is_registered(tmp_path, room):
    write_unregistered(tmp_path / "bag", room, WIDE, BESIDE)
    log = open_source(tmp_path / "bag")
    entry = log.entry_at(0)
    assert entry.files is None
    assert write_log(log, tmp_path / "tum", kind="tum") == []
    again = open_source(tmp_path / "tum")
    assert again.entry_at(0).depth_stamp_ns == log[0].depth_stamp_ns < log[0].stamp_ns
    np.testing.assert_allclose(again[0].depth_m, log[0].depth_m, atol=1.1e-4)
    assert again[0].camera == log[0].camera
    assert write_log(log, tmp_path / "log.mcap", kind="mcap") == []
    again = open_source(tmp_path / "log.mcap")
    np.testing.assert_array_equal(again[0].depth_m, log[0].depth_m)
    assert again[0].depth_stamp_ns == log[0].depth_stamp_ns


@pytest.mark.parametrize(
    ("kind", "encoding", "type_", "definition"),
    [
        (Stores.ROS1_NOETIC, "ros1", "realsense2_camera/msg/Extrinsics", "std_msgs/Header header\n"),
        (Stores.ROS2_HUMBLE, "cdr", "realsense2_camera_msgs/msg/Extrinsics", "std_msgs/Header header\n"),
        (Stores.ROS2_HUMBLE, "cdr", "realsense2_camera_msgs/msg/Extrinsics", ""),
    ],
)
def test_extrinsics_of_every_driver_are_read(kind, encoding, type_, definition):
    store = get_typestore(kind)
    store.register(get_types_from_msg(f"{definition}float64[9] rotation\nfloat64[3] translation\n", type_))
    header = []
    if definition:
        Header, Time = (store.types[name] for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"))
        sequence = [1] if encoding == "ros1" else []
        header = [Header(*sequence, Time(0, 0), "depth_to_color_extrinsics")]
    message = store.types[type_](*header, BESIDE[:3, :3].ravel(order="F"), BESIDE[:3, 3].copy())
    serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    data = memoryview(bytes(serialize(message, type_)))
    (pose,) = decode(Topic("/camera/extrinsics/depth_to_color", type_, encoding), data)
    np.testing.assert_allclose(pose.numbers, row_of_pose(BESIDE), atol=1e-12)


def test_a_rotation_that_is_none_is_a_damaged_message():
    numbers = np.array([*np.full(9, 0.5), 0.015, 0.0, 0.0])
    data = memoryview(b"\0\1\0\0" + numbers.astype("<f8").tobytes())
    topic = Topic("/camera/extrinsics/depth_to_color", "realsense2_camera_msgs/msg/Extrinsics", "cdr")
    huge = memoryview(b"\0\1\0\0" + np.full(12, 1e300).astype("<f8").tobytes())
    for damaged in (data, data[:60], huge):
        with pytest.raises(DataError):
            decode(topic, damaged)


def test_a_pose_that_is_not_stated_is_estimated_by_outlines(tmp_path, desk_log):
    """A tilted camera, as an Azure Kinect's."""
    registered = open_source(desk_log)[::3]
    T_color_depth = exp(np.radians([6.0, 0.3, -0.2]), np.array([-0.032, -0.002, 0.004]))
    camera = PinholeCamera(320, 288, 252.0, 252.0, 160.3, 150.1)
    write_unregistered(tmp_path / "bag", registered, camera, T_color_depth, stated_in=None)
    log = open_source(tmp_path / "bag")
    assert sum("estimated by outlines" in note for note in log.notes) == 1
    found, wanted = log[10], registered[10]
    both = (found.depth_m > 0.0) & (wanted.depth_m > 0.0)
    assert both.mean() > 0.8
    assert (np.abs(found.depth_m - wanted.depth_m) < 0.02 * wanted.depth_m)[both].mean() > 0.95


def test_depth_of_another_time_tells_no_pose(tmp_path, desk_log):
    registered = open_source(desk_log)[::3]
    half = len(registered) // 2
    late = changed_frames(registered, lambda i, frame: replace(frame, depth_m=registered[i - half].depth_m))
    write_unregistered(tmp_path / "bag", late, D435, stated_in=None)
    with pytest.raises(SourceError, match=r"standard deviations .*depth_in_color"):
        open_source(tmp_path / "bag")


def test_depth_without_a_pose_or_intrinsics_is_refused_with_the_setting(tmp_path):
    path = write(tmp_path / "a.mcap", unregistered(T=None))
    with pytest.raises(SourceError, match=r"\(106×60 px, focal length 53\.0 px\) .*\.depth_in_color"):
        open_source(path)
    beside = CameraConfig(depth_in_color=tuple(row_of_pose(BESIDE).tolist()))
    (note,) = (one for one in open_source(path, SourceConfig(camera=beside)).notes if "registered" in one)
    assert "source.camera.depth_in_color" in note
    path = write(tmp_path / "b.mcap", unregistered(CAMERA, info=False))
    with pytest.raises(SourceError, match=r"15 mm beside it by tf; .*source\.camera\.depth_intrinsics_px"):
        open_source(path)
    own = CameraConfig(depth_intrinsics_px=(60.0, 61.0, 31.5, 23.5))
    assert any("15.0 mm" in note for note in open_source(path, SourceConfig(camera=own)).notes)


def test_a_setting_goes_before_tf_and_says_that_depth_is_registered(tmp_path):
    messages = unregistered(CAMERA)
    assert any("as it is read" in note for note in opened(tmp_path / "a.mcap", messages).notes)
    same = CameraConfig(depth_in_color=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    log = open_source(tmp_path / "a.mcap", SourceConfig(camera=same))
    assert log.notes[-1] == "depth in frame depth_optical is taken to be registered to colour in optical"
    assert (log[0].depth_m == 2.0).all()
    turned = CameraConfig(
        depth_in_color=tuple(row_of_pose(exp(np.array([0.0, 0.0, 0.02]), np.zeros(3))).tolist())
    )
    log = open_source(tmp_path / "a.mcap", SourceConfig(camera=turned))
    assert 0.9 < (log[0].depth_m > 0.0).mean() < 1.0


def test_frames_that_tf_turns_against_each_other_are_not_optical(tmp_path):
    forward = exp(np.array([0.0, np.pi / 2, 0.0]), np.array([0.015, 0.0, 0.0]))
    with pytest.raises(SourceError, match=r"tf turns it by 90°.*depth_in_color"):
        opened(tmp_path / "a.mcap", unregistered(T=forward))


def test_a_pose_of_the_topic_that_contradicts_tf_is_noted(tmp_path, room):
    write_unregistered(tmp_path / "bag", room, WIDE, inverse(BESIDE), also_topic=BESIDE)
    log = open_source(tmp_path / "bag")
    (note,) = (note for note in log.notes if "another pose" in note)
    numbers = [float(word) for word in note[note.index("=[") + 2 : -1].split(",")]
    np.testing.assert_allclose(numbers, row_of_pose(BESIDE), atol=1e-5)


def test_colour_of_a_wide_image_is_reduced_and_depth_is_as_large(tmp_path):
    rgb, _ = picture(0, width_px=1280, height_px=720)
    color = PinholeCamera(1280, 720, 920.0, 920.0, 639.5, 359.5)
    wall = np.full((60, 106), 2000, np.uint16)
    messages = [
        transforms(("optical", "depth_optical", BESIDE)),
        image(FIRST_NS, COLOR, rgb, "rgb8"),
        image(FIRST_NS, DEPTH, wall, "16UC1", frame="depth_optical"),
        camera_info(FIRST_NS, camera=color),
        camera_info(FIRST_NS, "/cam/depth/camera_info", WIDE),
    ]
    frame = opened(tmp_path / "a.mcap", messages)[0]
    assert frame.image.shape == (360, 640, 3)
    assert frame.camera == color.resized(640, 360)
    assert (frame.depth_m > 0.0).mean() > 0.95
    np.testing.assert_allclose(frame.depth_m[frame.depth_m > 0.0], 2.0, atol=0.05)


def stream_pose(topic, T):
    x, y, z, *q = row_of_pose(T).tolist()
    message = make_message(
        "geometry_msgs/msg/Transform",
        translation=make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        rotation=make_message("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q, strict=True))),
    )
    return SerializedMessage(FIRST_NS, topic, "geometry_msgs/msg/Transform", serialize(message))


def test_a_recording_of_realsense_viewer_states_the_pose_of_each_stream(tmp_path):
    color, depth = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    names = {COLOR: f"{color}/image/data", DEPTH: f"{depth}/image/data"}
    names |= {"/cam/color/camera_info": f"{color}/info/camera_info"}
    names |= {"/cam/depth/camera_info": f"{depth}/info/camera_info"}
    frames = [m._replace(topic=names[m.topic]) for m in unregistered(T=None, frame="optical")]
    with pytest.raises(SourceError, match="depth_in_color"):
        opened(tmp_path / "a.bag", frames)
    T_depth_reference = exp(np.array([0.01, 0.0, 0.02]), np.array([0.0, -0.01, 0.0]))
    poses = [
        stream_pose(f"{color}/tf/0", BESIDE @ T_depth_reference),
        stream_pose(f"{depth}/tf/0", T_depth_reference),
    ]
    log = opened(tmp_path / "b.bag", [*frames, *poses])
    (note,) = (one for one in log.notes if "as it is read" in one)
    assert "15.0 mm" in note
    assert "0.54°" in note
    np.testing.assert_allclose(log[0].depth_m[20:28, 28:36], 2.0, atol=0.02)


def test_depth_in_colour_s_frame_is_registered_whatever_the_driver_s_topic_says(tmp_path):
    of_driver = extrinsics(BESIDE, topic="/cam/extrinsics/depth_to_color")
    for frame, is_registered in (("optical", True), ("depth_optical", False)):
        messages = [of_driver, *unregistered(CAMERA, T=None, frame=frame)]
        notes = opened(tmp_path / frame, messages).notes
        assert any("as it is read" in note for note in notes) != is_registered


def test_calibrations_that_are_not_set_yet_are_passed_over_and_changes_are_noted(tmp_path):
    messages = shots(6)
    for i, focal_px in ((2, 0.0), (5, 0.0), (14, 90.0), (17, 90.0)):
        cdr = messages[i].cdr.replace(struct.pack("<d", CAMERA.fx_px), struct.pack("<d", focal_px))
        messages[i] = messages[i]._replace(cdr=cdr)
    log = open_source(write(tmp_path / "a.mcap", messages))
    assert log[0].camera == CAMERA
    assert sum("intrinsics change" in note for note in log.notes) == 1
    assert not any("intrinsics" in note for note in open_source(write(tmp_path / "b.mcap", shots(6))).notes)


def test_a_calibration_of_p_alone_tells_the_depth_camera_from_colours(tmp_path):
    without_k = [
        changed(one, k=np.zeros(9)) if one.topic == "/cam/depth/camera_info" else one
        for one in unregistered(T=None)
    ]
    assert without_k != unregistered(T=None)
    with pytest.raises(SourceError, match=r"focal length 53\.0 px\) is not registered"):
        opened(tmp_path / "a.mcap", without_k)


@pytest.mark.parametrize(("name", "is_rectified"), [("image_rect_color", True), ("image_unrectified", False)])
def test_rectified_images_are_known_by_their_name(name, is_rectified):
    assert is_called_rectified(f"/camera/color/{name}") == is_rectified
