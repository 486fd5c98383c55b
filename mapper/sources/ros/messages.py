"""Decoded messages, the same for every encoding, and the ROS and Foxglove types that become each of them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform


@dataclass(frozen=True, slots=True, eq=False)
class PixelsMessage:
    """An image as rows of pixels (sensor_msgs/Image, foxglove.RawImage).

    Attributes:
        stamp_ns: Time of the image.
        frame: Coordinate frame of its camera.
        encoding: E.g. "rgb8", "16UC1".
        width_px: Pixels of a row.
        height_px: Rows.
        row_bytes: Bytes of a row, padding included.
        is_big_endian: Whether pixels of several bytes are stored highest byte first.
        data: The rows.
    """

    stamp_ns: int
    frame: str
    encoding: str
    width_px: int
    height_px: int
    row_bytes: int
    is_big_endian: bool
    data: memoryview


@dataclass(frozen=True, slots=True, eq=False)
class FileMessage:
    """An image as the bytes of an image file (CompressedImage), maybe behind compressedDepth's own header.

    Attributes:
        stamp_ns: Time of the image.
        frame: Coordinate frame of its camera.
        format: Format in the message's words, e.g. "jpeg" or "16UC1; compressedDepth png".
        data: The file.
    """

    stamp_ns: int
    frame: str
    format: str
    data: memoryview


@dataclass(frozen=True, slots=True, eq=False)
class CameraMessage:
    """A camera's calibration (sensor_msgs/CameraInfo, foxglove.CameraCalibration).

    Attributes:
        frame: Coordinate frame of the camera.
        width_px: Image width.
        height_px: Image height.
        model: Distortion model, e.g. "plumb_bob".
        D: Its coefficients.
        K: (9,) intrinsics of the raw image, row by row.
        P: (12,) intrinsics of the rectified image, row by row.
    """

    frame: str
    width_px: int
    height_px: int
    model: str
    D: Array
    K: Array
    P: Array


@dataclass(frozen=True, slots=True, eq=False)
class CloudMessage:
    """A point cloud (sensor_msgs/PointCloud2, foxglove.PointCloud).

    Attributes:
        stamp_ns: Time of the cloud.
        frame: Coordinate frame of the points.
        points: (N,) structured view of the message's own bytes; organised rows follow each other.
        T_frame_points: Pose of the points in ``frame``; only Foxglove's clouds have another than identity.
    """

    stamp_ns: int
    frame: str
    points: NDArray[np.void]
    T_frame_points: Transform = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, slots=True, eq=False)
class PoseMessage:
    """Pose of a coordinate frame in another (TransformStamped, PoseStamped, Odometry and Foxglove's).

    Attributes:
        stamp_ns: Time of the pose.
        parent: The frame in which the pose is given.
        child: The frame whose pose it is; "" where the message does not name it.
        numbers: x y z in metres and qx qy qz qw of T_parent_child; they may be no pose.
    """

    stamp_ns: int
    parent: str
    child: str
    numbers: Sequence[float]


@dataclass(frozen=True, slots=True, eq=False)
class ImuMessage:
    """A reading of an inertial measurement unit (sensor_msgs/Imu).

    Attributes:
        stamp_ns: Time of the reading.
        frame: The unit's frame.
        acceleration_mps2: (3,) specific force: it points up at rest.
    """

    stamp_ns: int
    frame: str
    acceleration_mps2: Array


ImageMessage = PixelsMessage | FileMessage
Message = ImageMessage | CameraMessage | CloudMessage | ImuMessage | list[PoseMessage]

PIXELS = frozenset({"sensor_msgs/msg/Image", "foxglove.RawImage"})
FILES = frozenset({"sensor_msgs/msg/CompressedImage", "foxglove.CompressedImage"})
IMAGES = PIXELS | FILES
CAMERAS = frozenset({"sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration"})
CLOUDS = frozenset({"sensor_msgs/msg/PointCloud2", "foxglove.PointCloud"})
IMUS = frozenset({"sensor_msgs/msg/Imu"})
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = frozenset(
    {
        ODOMETRY,
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
        "foxglove.PoseInFrame",
    }
)
TRANSFORMS = frozenset(
    {"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", "foxglove.FrameTransform", "foxglove.FrameTransforms"}
)
WITH_HEADER = IMAGES | CAMERAS | CLOUDS | IMUS | POSES | {"foxglove.FrameTransform"}
READ = WITH_HEADER | TRANSFORMS
SMALL = IMUS | POSES | TRANSFORMS
