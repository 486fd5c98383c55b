"""ROS messages written: serialised by rosbags, into ROS 1 bags by it too; its second home."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer

from mapper.core.frames import PinholeCamera, Scan
from mapper.core.geometry import Array, Transform
from mapper.core.rotations import quaternion_from_rotation
from mapper.core.timebase import NS_PER_S
from mapper.runtime.atomic import atomic_file
from mapper.sources.ros.decode_ros import typestore
from mapper.sources.ros.log_writing import Written

_CLOUD_TYPES = {"f4": 7, "u4": 6}  # PointField's constants


def definition(type_: str) -> str:
    """Return the text that defines a message type and all that it is made of, as ROS 2 has it."""
    text, _ = typestore("cdr").generate_msgdef(type_, ros_version=2)
    return str(text)


def image_message(
    stamp_ns: int, pixels: NDArray[np.uint8] | NDArray[np.float32], *, encoding: str, frame: str
) -> bytes:
    """Return a sensor_msgs/msg/Image of (H, W, …) pixels."""
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
    return _encoded(
        "sensor_msgs/msg/Image",
        _header(stamp_ns, frame),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=data.size // height,
        data=data,
    )


def compressed_image_message(stamp_ns: int, file: bytes, *, format_: str, frame: str) -> bytes:
    """Return a sensor_msgs/msg/CompressedImage."""
    data = np.frombuffer(file, np.uint8)
    return _encoded("sensor_msgs/msg/CompressedImage", _header(stamp_ns, frame), format=format_, data=data)


def camera_info_message(stamp_ns: int, camera: PinholeCamera, *, frame: str) -> bytes:
    """Return a sensor_msgs/msg/CameraInfo."""
    K = camera.matrix
    return _encoded(
        "sensor_msgs/msg/CameraInfo",
        _header(stamp_ns, frame),
        height=camera.height_px,
        width=camera.width_px,
        distortion_model="plumb_bob",
        d=np.array(camera.distortion),
        k=K.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([K, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=_made(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )


def cloud_message(scan: Scan, *, frame: str) -> bytes:
    """Return a sensor_msgs/msg/PointCloud2 of a scan's points, times and colours."""
    columns = [(name, "f4") for name in "xyz"]
    columns += [("time", "f4")] if scan.times_s is not None else []
    columns += [("rgb", "u4")] if scan.colors is not None else []
    points = np.empty(len(scan.points_body), np.dtype([(name, f"<{kind}") for name, kind in columns]))
    for axis, name in enumerate("xyz"):
        points[name] = scan.points_body[:, axis]
    if scan.times_s is not None:
        points["time"] = scan.times_s
    if scan.colors is not None:
        red, green, blue = scan.colors.T.astype(np.uint32)
        points["rgb"] = red << 16 | green << 8 | blue
    fields = [
        _made("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=_CLOUD_TYPES[kind], count=1)
        for i, (name, kind) in enumerate(columns)
    ]
    return _encoded(
        "sensor_msgs/msg/PointCloud2",
        _header(scan.stamp_ns, frame),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )


def pose_message(stamp_ns: int, T_frame_body: Transform, *, frame: str) -> bytes:
    """Return a geometry_msgs/msg/PoseStamped."""
    return _encoded("geometry_msgs/msg/PoseStamped", _header(stamp_ns, frame), pose=_pose(T_frame_body))


def odometry_message(stamp_ns: int, T_frame_child: Transform, *, frame: str, child: str) -> bytes:
    """Return a nav_msgs/msg/Odometry of poses alone: nothing is told of velocities, nor of covariances."""
    zero = _made("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    still, unknown = _made("geometry_msgs/msg/Twist", linear=zero, angular=zero), np.zeros(36)
    return _encoded(
        "nav_msgs/msg/Odometry",
        _header(stamp_ns, frame),
        child_frame_id=child,
        pose=_made("geometry_msgs/msg/PoseWithCovariance", pose=_pose(T_frame_child), covariance=unknown),
        twist=_made("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=unknown),
    )


def imu_message(stamp_ns: int, acceleration_mps2: Array, *, frame: str) -> bytes:
    """Return a sensor_msgs/msg/Imu with accelerations only; a first covariance of −1 marks the absent."""
    x, y, z = acceleration_mps2.tolist()
    absent = np.array([-1.0, *[0.0] * 8])
    zero = _made("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    return _encoded(
        "sensor_msgs/msg/Imu",
        _header(stamp_ns, frame),
        orientation=_made("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=absent,
        angular_velocity=zero,
        angular_velocity_covariance=absent,
        linear_acceleration=_made("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        linear_acceleration_covariance=np.zeros(9),
    )


class BagWriter:
    """Writes a ROS 1 bag; see :class:`mapper.sources.ros.log_writing.MessageWriter`."""

    def __init__(self, writer: Writer) -> None:
        """Write to an open bag."""
        self._writer = writer
        self._connections: dict[str, Any] = {}

    def write(self, message: Written) -> None:
        """Append a message, in ROS 1's serialisation."""
        if message.topic not in self._connections:
            self._connections[message.topic] = self._writer.add_connection(
                message.topic, message.type, typestore=typestore("ros1")
            )
        data = typestore("cdr").cdr_to_ros1(message.cdr, message.type)
        self._writer.write(self._connections[message.topic], message.stamp_ns, data)


@contextmanager
def bag_writer(path: Path) -> Iterator[BagWriter]:
    """Yield a writer of a ROS 1 bag, compressed by LZ4, that appears whole or not at all."""
    with atomic_file(path) as part:
        writer = Writer(part)
        writer.set_compression(Writer.CompressionFormat.LZ4)
        with writer:
            yield BagWriter(writer)


def _made(type_: str, **fields: Any) -> Any:
    return typestore("cdr").types[type_](**fields)


def _pose(T_frame_body: Transform) -> Any:
    x, y, z = T_frame_body[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_rotation(T_frame_body[:3, :3]).tolist()
    return _made(
        "geometry_msgs/msg/Pose",
        position=_made("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=_made("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )


def _header(stamp_ns: int, frame: str) -> Any:
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    stamp = _made("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return _made("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _encoded(type_: str, header: Any, **fields: Any) -> bytes:
    return bytes(typestore("cdr").serialize_cdr(_made(type_, header=header, **fields), type_))
