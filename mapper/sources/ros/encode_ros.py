"""Serialised ROS 2 messages of logs and maps: images, calibrations, clouds, poses, accelerations, octrees."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import PinholeCamera, Scan
from mapper.core.geometry import Array, Transform
from mapper.core.trajectory import Trajectory
from mapper.sources.ros.decode_ros import POINT_FIELD_TYPES
from mapper.sources.ros.typestore import make_header, make_message, make_pose, serialize

_POINT_FIELD_TYPES = {kind: number for number, kind in POINT_FIELD_TYPES.items()}


class SerializedMessage(NamedTuple):
    """A ROS 2 message to write.

    Attributes:
        stamp_ns: Time of the message.
        topic: Topic on which it is published.
        type: E.g. "sensor_msgs/msg/Image".
        cdr: The message as CDR, little-endian.
        is_latched: Whether those who subscribe later get it too; all messages of a topic are alike in this.
    """

    stamp_ns: int
    topic: str
    type: str
    cdr: bytes
    is_latched: bool = False


def image_message(
    stamp_ns: int,
    topic: str,
    pixels: NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32],
    *,
    encoding: str,
    frame: str,
) -> SerializedMessage:
    """Return a sensor_msgs/msg/Image of (H, W, …) pixels."""
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
    return _serialized(
        "sensor_msgs/msg/Image",
        stamp_ns,
        topic,
        frame,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=data.size // height,
        data=data,
    )


def compressed_image_message(
    stamp_ns: int, topic: str, file: bytes, *, format_: str, frame: str
) -> SerializedMessage:
    """Return a sensor_msgs/msg/CompressedImage of an image file."""
    data = np.frombuffer(file, np.uint8)
    return _serialized("sensor_msgs/msg/CompressedImage", stamp_ns, topic, frame, format=format_, data=data)


def camera_info_message(stamp_ns: int, topic: str, camera: PinholeCamera, *, frame: str) -> SerializedMessage:
    """Return a sensor_msgs/msg/CameraInfo."""
    K = camera.matrix
    return _serialized(
        "sensor_msgs/msg/CameraInfo",
        stamp_ns,
        topic,
        frame,
        height=camera.height_px,
        width=camera.width_px,
        distortion_model="plumb_bob",
        d=np.array(camera.distortion),
        k=K.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([K, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=make_message(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )


def cloud_message(topic: str, scan: Scan, *, frame: str) -> SerializedMessage:
    """Return a sensor_msgs/msg/PointCloud2 of a scan's points, intensities, times and colours."""
    columns = [(name, "f4") for name in "xyz"]
    columns += [("intensity", "f4")] if scan.intensities is not None else []
    columns += [("time", "f4")] if scan.times_s is not None else []
    columns += [("rgb", "u4")] if scan.colors is not None else []
    points = np.empty(len(scan.points_body), np.dtype([(name, f"<{kind}") for name, kind in columns]))
    for axis, name in enumerate("xyz"):
        points[name] = scan.points_body[:, axis]
    if scan.intensities is not None:
        points["intensity"] = scan.intensities
    if scan.times_s is not None:
        points["time"] = scan.times_s
    if scan.colors is not None:
        red, green, blue = scan.colors.T.astype(np.uint32)
        points["rgb"] = red << 16 | green << 8 | blue
    fields = [
        make_message(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=4 * i,
            datatype=_POINT_FIELD_TYPES[kind],
            count=1,
        )
        for i, (name, kind) in enumerate(columns)
    ]
    return _serialized(
        "sensor_msgs/msg/PointCloud2",
        scan.stamp_ns,
        topic,
        frame,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )


def pose_message(stamp_ns: int, topic: str, T_frame_body: Transform, *, frame: str) -> SerializedMessage:
    """Return a geometry_msgs/msg/PoseStamped."""
    return _serialized("geometry_msgs/msg/PoseStamped", stamp_ns, topic, frame, pose=make_pose(T_frame_body))


def path_message(stamp_ns: int, topic: str, trajectory: Trajectory, *, frame: str) -> SerializedMessage:
    """Return a nav_msgs/msg/Path of a trajectory, each pose with its own stamp."""
    poses = [
        make_message("geometry_msgs/msg/PoseStamped", header=make_header(at_ns, frame), pose=make_pose(T))
        for at_ns, T in trajectory.items()
    ]
    return _serialized("nav_msgs/msg/Path", stamp_ns, topic, frame, poses=poses)


def transforms_message(
    stamp_ns: int, topic: str, transforms: Sequence[tuple[str, str, Transform]]
) -> SerializedMessage:
    """Return a tf2_msgs/msg/TFMessage of (parent, child, T_parent_child)."""
    stamped = []
    for parent, child, T_parent_child in transforms:
        pose = make_pose(T_parent_child)
        transform = make_message(
            "geometry_msgs/msg/Transform",
            translation=_vector(*T_parent_child[:3, 3].tolist()),
            rotation=pose.orientation,
        )
        header = make_header(stamp_ns, parent)
        stamped.append(
            make_message(
                "geometry_msgs/msg/TransformStamped",
                header=header,
                child_frame_id=child,
                transform=transform,
            )
        )
    type_ = "tf2_msgs/msg/TFMessage"
    return SerializedMessage(stamp_ns, topic, type_, serialize(make_message(type_, transforms=stamped)))


def octomap_message(
    stamp_ns: int, topic: str, words: NDArray[np.uint16], *, resolution_m: float, frame: str
) -> SerializedMessage:
    """Return an octomap_msgs/msg/Octomap of free and occupied voxels.

    Args:
        stamp_ns: Time of the message.
        topic: Topic on which it is published.
        words: What follows the header of a ``.bt`` file.
        resolution_m: Edge of a voxel, metres.
        frame: Frame of the octree.
    """
    return _serialized(
        "octomap_msgs/msg/Octomap",
        stamp_ns,
        topic,
        frame,
        binary=True,
        id="OcTree",
        resolution=resolution_m,
        data=words.view(np.int8),
    )


def odometry_message(
    stamp_ns: int, topic: str, T_frame_child: Transform, *, frame: str, child: str
) -> SerializedMessage:
    """Return a nav_msgs/msg/Odometry of a pose alone: velocities and covariances are zero."""
    zero, no_covariance = _vector(0.0, 0.0, 0.0), np.zeros(36)
    return _serialized(
        "nav_msgs/msg/Odometry",
        stamp_ns,
        topic,
        frame,
        child_frame_id=child,
        pose=make_message(
            "geometry_msgs/msg/PoseWithCovariance", pose=make_pose(T_frame_child), covariance=no_covariance
        ),
        twist=make_message(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=make_message("geometry_msgs/msg/Twist", linear=zero, angular=zero),
            covariance=no_covariance,
        ),
    )


def imu_message(
    stamp_ns: int, topic: str, *, rates_radps: Array | None, acceleration_mps2: Array | None, frame: str
) -> SerializedMessage:
    """Return a sensor_msgs/msg/Imu of either reading or both; −1 begins the covariance of what is absent."""
    absent = np.array([-1.0, *[0.0] * 8])
    rates, acceleration = (
        np.zeros(3) if reading is None else reading for reading in (rates_radps, acceleration_mps2)
    )
    return _serialized(
        "sensor_msgs/msg/Imu",
        stamp_ns,
        topic,
        frame,
        orientation=make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=absent,
        angular_velocity=_vector(*rates.tolist()),
        angular_velocity_covariance=absent if rates_radps is None else np.zeros(9),
        linear_acceleration=_vector(*acceleration.tolist()),
        linear_acceleration_covariance=absent if acceleration_mps2 is None else np.zeros(9),
    )


def fix_message(
    stamp_ns: int, topic: str, *, geodetic: Array, covariance_enu: Array, status: int, frame: str
) -> SerializedMessage:
    """Return a sensor_msgs/msg/NavSatFix; of a covariance with NaN the type is unknown."""
    latitude_deg, longitude_deg, height_m = geodetic.tolist()
    is_known = bool(np.isfinite(covariance_enu).all())
    kind = make_message("sensor_msgs/msg/NavSatStatus", status=status, service=1)
    return _serialized(
        "sensor_msgs/msg/NavSatFix",
        stamp_ns,
        topic,
        frame,
        status=kind,
        latitude=latitude_deg,
        longitude=longitude_deg,
        altitude=height_m,
        position_covariance=covariance_enu.ravel() if is_known else np.zeros(9),
        position_covariance_type=3 if is_known else 0,
    )


def _serialized(type_: str, stamp_ns: int, topic: str, frame: str, **fields: Any) -> SerializedMessage:
    message = make_message(type_, header=make_header(stamp_ns, frame), **fields)
    return SerializedMessage(stamp_ns, topic, type_, serialize(message))


def _vector(x: float, y: float, z: float) -> Any:
    return make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
