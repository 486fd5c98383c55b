"""ROS messages decoded, from CDR (ROS 2) or ROS 1's serialisation.

Those of LiDAR drivers' own types, Livox' CustomMsg and Velodyne's packets, are unpacked here, as a general
decoder makes an object of each of a message's 20 000 points. ROS 1 packs the elements of an array; CDR aligns
them.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError

from mapper.core.errors import DataError, listed
from mapper.core.geometry import is_rigid, transform
from mapper.core.rotations import row_of_pose
from mapper.core.timebase import NS_PER_S
from mapper.sources.laser_scan import laser_records
from mapper.sources.ros.cloud_messages import in_true_order, structured, usable_fields, without_noise
from mapper.sources.ros.messages import (
    DRIVER_CLOUDS,
    EXTRINSICS,
    GPS_FIXES,
    LIVOX,
    CameraMessage,
    CloudMessage,
    FileMessage,
    FixMessage,
    ImuMessage,
    Message,
    PixelsMessage,
    PoseMessage,
    SentenceMessage,
    Window,
)
from mapper.sources.ros.recording import Topic
from mapper.sources.ros.typestore import typestore
from mapper.sources.velodyne_packets import PACKET_BYTES, decode_packets

POINT_FIELD_TYPES = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), start=1))
"""Numpy's names of PointField's constants."""
_EXTRINSICS_NUMBERS = 12
_GPS_STATUS = {18: 2, 19: 2, 20: 2, 33: 1}
"""GPSStatus's own numbers of differential, RTK, RTK with floating ambiguities and WAAS, as NavSatStatus's."""
_HEADER_BYTES = 16
"""Four of the encapsulation (CDR) or of a counter (ROS 1), then seconds, nanoseconds, the frame's length."""
_COUNT = ("count", "u4")
_LIVOX_HEAD = [("timebase", "u8"), ("point_num", "u4"), ("lidar_id", "u1"), ("rsvd", "u1", 3), _COUNT]
_LIVOX_POINT = [
    *[("offset_time", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4")],
    *[("reflectivity", "u1"), ("tag", "u1"), ("line", "u1")],
]
_VELODYNE_PACKET = [("sec", "u4"), ("nanosec", "u4"), ("data", "u1", PACKET_BYTES)]


def decode_ros(topic: Topic, data: memoryview) -> Message:
    """Return a decoded ROS message; its payload is a view of ``data``.

    Raises:
        DataError: The message is damaged, or of a type that is not read.
        DependencyError: The library that decodes a driver's packets is not installed.
    """
    if topic.type in EXTRINSICS:
        return _extrinsics(data, is_little_endian=topic.encoding == "ros1" or bool(data[1] & 1))
    if topic.type in DRIVER_CLOUDS:
        return decode_driver_message(topic, data)
    read = _READERS.get(topic.type)
    if read is None:
        raise DataError(f"messages of type {topic.type} are not read")
    store = typestore(topic.encoding)
    deserialize = store.deserialize_ros1 if topic.encoding == "ros1" else store.deserialize_cdr
    try:
        message = deserialize(data, topic.type)
    except (SerdeError, AssertionError, IndexError, ValueError):  # raised for damaged lengths
        raise DataError(
            f"a damaged message: its {len(data)} bytes end early or are no {topic.type}"
        ) from None
    return read(message)


def _pixels(m: Any) -> PixelsMessage:
    return PixelsMessage(
        stamp_ns=_ns(m.header.stamp),
        frame=m.header.frame_id,
        encoding=m.encoding,
        width_px=m.width,
        height_px=m.height,
        row_bytes=m.step,
        is_big_endian=bool(m.is_bigendian),
        data=memoryview(m.data),
    )


def _file(m: Any) -> FileMessage:
    return FileMessage(_ns(m.header.stamp), m.header.frame_id, m.format, memoryview(m.data))


def _camera(m: Any) -> CameraMessage:
    D, K, P, R = (
        np.asarray(getattr(m, name.lower(), getattr(m, name, None)), dtype=np.float64) for name in "DKPR"
    )
    roi = m.roi
    window = Window(roi.x_offset, roi.y_offset, roi.width, roi.height, m.binning_x or 1, m.binning_y or 1)
    return CameraMessage(m.header.frame_id, m.width, m.height, m.distortion_model, D, K, P, window, R)


def _cloud(m: Any) -> CloudMessage:
    order = ">" if m.is_bigendian else "<"
    stated = [(f.name, f.offset, f.datatype, f.count) for f in m.fields]
    fields, notes = usable_fields(stated, POINT_FIELD_TYPES, order=order, point_bytes=m.point_step)
    packed_bytes = m.width * m.point_step
    if m.height > 1 and m.row_step not in (0, packed_bytes) and len(m.data) == m.height * packed_bytes:
        notes.append(f"row_step is {m.row_step}, but the rows follow each other every {packed_bytes} bytes")
    points = structured(
        memoryview(m.data),
        fields,
        point_bytes=m.point_step,
        shape=(m.height, m.width),
        row_bytes=m.row_step,
    )
    if m.is_bigendian:
        points, order_notes = in_true_order(points)
        notes += order_notes
    points, noise_notes = without_noise(points)
    return CloudMessage(_ns(m.header.stamp), m.header.frame_id, points, notes=[*notes, *noise_notes])


def _laser(m: Any) -> CloudMessage:
    points = laser_records(
        m.ranges,
        first_rad=m.angle_min,
        step_rad=m.angle_increment,
        limits_m=(m.range_min, m.range_max if m.range_max > 0.0 else np.inf),
        step_s=m.time_increment,
        intensities=m.intensities,
    )
    return CloudMessage(_ns(m.header.stamp), m.header.frame_id, points)


def _first_echoes(m: Any) -> CloudMessage:
    """Return the nearest return of each beam of a laser that sees several."""
    first = {
        name: np.array([beam.echoes[0] if len(beam.echoes) else np.inf for beam in getattr(m, name)])
        for name in ("ranges", "intensities")
    }
    return _laser(replace(m, **first))


def _old_cloud(m: Any) -> CloudMessage:
    """Return a cloud of PointCloud2's predecessor: points, and channels of a number for each."""
    numbers = {axis: [getattr(point, axis) for point in m.points] for axis in "xyz"}
    whole = {one.name: one.values for one in m.channels if len(one.values) == len(m.points)}
    numbers = whole | numbers
    points = np.zeros(len(m.points), [(name, "f4") for name in numbers])
    for name, values in numbers.items():
        points[name] = values
    left_out = [one.name for one in m.channels if one.name not in numbers]
    notes = [f"channels whose length is not the cloud's are left out: {listed(left_out)}"] if left_out else []
    return CloudMessage(_ns(m.header.stamp), m.header.frame_id, points, notes=notes)


def _imu(m: Any) -> ImuMessage:
    a = m.linear_acceleration
    return ImuMessage(_ns(m.header.stamp), m.header.frame_id, np.array([a.x, a.y, a.z]))


def _fix(m: Any) -> FixMessage:
    covariance = np.asarray(m.position_covariance, np.float64).reshape(3, 3)
    if m.position_covariance_type == m.COVARIANCE_TYPE_UNKNOWN:
        covariance = np.full((3, 3), np.nan)
    place = np.array([m.latitude, m.longitude, m.altitude])
    status = _GPS_STATUS.get(m.status.status, m.status.status)
    return FixMessage(_ns(m.header.stamp), m.header.frame_id, status, place, covariance)


def _sentence(m: Any) -> SentenceMessage:
    return SentenceMessage(_ns(m.header.stamp), m.header.frame_id, m.sentence)


def _pose_stamped(m: Any) -> list[PoseMessage]:
    pose = getattr(m.pose, "pose", m.pose)  # with or without covariance
    return [_pose(m.header, getattr(m, "child_frame_id", ""), pose.position, pose.orientation)]


def _point_stamped(m: Any) -> list[PoseMessage]:
    point = m.point.x, m.point.y, m.point.z
    return [PoseMessage(_ns(m.header.stamp), m.header.frame_id, "", (*point, 0.0, 0.0, 0.0, 1.0))]


def _transform_stamped(m: Any) -> list[PoseMessage]:
    return [_pose(m.header, m.child_frame_id, m.transform.translation, m.transform.rotation)]


def _transforms(m: Any) -> list[PoseMessage]:
    return [pose for transform in m.transforms for pose in _transform_stamped(transform)]


def _transform(m: Any) -> list[PoseMessage]:
    p, q = m.translation, m.rotation
    return [PoseMessage(0, "", "", (p.x, p.y, p.z, q.x, q.y, q.z, q.w))]


def _extrinsics(data: memoryview, *, is_little_endian: bool) -> list[PoseMessage]:
    """Return the pose of the depth stream in another, as the topic's name says, of RealSense's Extrinsics.

    A rotation, column by column, and a translation in metres end the message; a header is before them, or
    none, by the driver's version.
    """
    size_bytes = 8 * _EXTRINSICS_NUMBERS
    if len(data) < size_bytes:
        raise DataError(f"a damaged message: {len(data)} bytes, want at least {size_bytes}")
    numbers = np.frombuffer(data[-size_bytes:], "<f8" if is_little_endian else ">f8").astype(np.float64)
    T = transform(numbers[:9].reshape(3, 3).T, numbers[9:])
    if not is_rigid(T):
        raise DataError("a damaged message: it is no rigid motion")
    return [PoseMessage(0, "", "", row_of_pose(T).tolist())]


_READERS: Mapping[str, Callable[[Any], Message]] = {
    "sensor_msgs/msg/Image": _pixels,
    "sensor_msgs/msg/CompressedImage": _file,
    "sensor_msgs/msg/CameraInfo": _camera,
    "sensor_msgs/msg/PointCloud2": _cloud,
    "sensor_msgs/msg/PointCloud": _old_cloud,
    "sensor_msgs/msg/LaserScan": _laser,
    "sensor_msgs/msg/MultiEchoLaserScan": _first_echoes,
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/NavSatFix": _fix,
    **dict.fromkeys(GPS_FIXES, _fix),
    "nmea_msgs/msg/Sentence": _sentence,
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_stamped,
    "nav_msgs/msg/Odometry": _pose_stamped,
    "geometry_msgs/msg/PointStamped": _point_stamped,
    "geometry_msgs/msg/TransformStamped": _transform_stamped,
    "geometry_msgs/msg/Transform": _transform,
    "tf2_msgs/msg/TFMessage": _transforms,
    "tf/msg/tfMessage": _transforms,
}


def _pose(header: Any, child: str, p: Any, q: Any) -> PoseMessage:
    numbers = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
    return PoseMessage(_ns(header.stamp), header.frame_id, child, numbers)


def _ns(stamp: Any) -> int:
    return int(stamp.sec * NS_PER_S + stamp.nanosec)


def decode_driver_message(topic: Topic, data: memoryview) -> CloudMessage:
    """Return the points of a CustomMsg of livox_ros_driver or of a VelodyneScan, with times after the stamp.

    Raises:
        DataError: Its packets are damaged, or of a Velodyne that is not known, or its fields are others.
        ValueError: It has fewer bytes than its number of points or packets needs.
        DependencyError: The library that decodes packets is not installed.
    """
    if topic.type in LIVOX:
        stamp_ns, frame, points = _unpack(topic, data, _LIVOX_HEAD, _LIVOX_POINT)
        points, notes = without_noise(points)
        return CloudMessage(stamp_ns, frame, points, notes=notes)
    stamp_ns, frame, packets = _unpack(topic, data, [_COUNT], _VELODYNE_PACKET)
    received_ns = packets["sec"].astype(np.int64) * NS_PER_S + packets["nanosec"]
    payloads = [packet.tobytes() for packet in packets["data"]]
    return CloudMessage(stamp_ns, frame, decode_packets(payloads, received_ns, stamp_ns))


def _unpack(
    topic: Topic, data: memoryview, head: list[Any], element: list[Any]
) -> tuple[int, str, NDArray[np.void]]:
    """Return the stamp, the frame and the (N,) elements of the array that ends a message."""
    is_cdr = topic.encoding != "ros1"
    order: Literal["<", ">"] = ">" if is_cdr and not data[1] & 1 else "<"
    sec, nanosec, frame_bytes = np.frombuffer(data, f"{order}u4", count=3, offset=4).tolist()
    start = _HEADER_BYTES + frame_bytes
    frame = bytes(data[_HEADER_BYTES:start]).rstrip(b"\0").decode(errors="replace")
    head_type = np.dtype(head).newbyteorder(order)
    if is_cdr:
        start += -(start - 4) % head_type[0].itemsize  # counted from the end of the encapsulation
    count = int(np.frombuffer(data, head_type, count=1, offset=start)["count"][0])
    elements = bytes(data[start + head_type.itemsize :]) + b"\0\0\0"  # the last one is not padded
    element_type = np.dtype(element, align=is_cdr).newbyteorder(order)
    if (spare := len(elements) - count * element_type.itemsize) >= element_type.itemsize:
        raise DataError(f"{spare} bytes after {count} elements: a {topic.type} with other fields")
    return sec * NS_PER_S + nanosec, frame, np.frombuffer(elements, element_type, count=count)
