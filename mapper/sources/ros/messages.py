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


@dataclass(frozen=True, slots=True)
class Window:
    """Part of the sensor that an image shows (CameraInfo's roi and binning), in pixels of the full sensor.

    Attributes:
        x_px: First column.
        y_px: First row.
        width_px: Columns; 0 for all.
        height_px: Rows; 0 for all.
        binning_x: Columns that one pixel of the image sums up.
        binning_y: As ``binning_x``, of rows.
    """

    x_px: int = 0
    y_px: int = 0
    width_px: int = 0
    height_px: int = 0
    binning_x: int = 1
    binning_y: int = 1


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
        window: Part of the sensor that the images show; size, K and P are the full sensor's.
        R: (9,) rotation from the raw camera's axes to the rectified one's, row by row.
    """

    frame: str
    width_px: int
    height_px: int
    model: str
    D: Array
    K: Array
    P: Array
    window: Window = Window()
    R: Array = field(default_factory=lambda: np.eye(3).ravel())


@dataclass(frozen=True, slots=True, eq=False)
class CloudMessage:
    """A point cloud (sensor_msgs/PointCloud2, foxglove.PointCloud, a driver's own), or a 2D laser's returns.

    Attributes:
        stamp_ns: Time of the cloud.
        frame: Coordinate frame of the points.
        points: (N,) records, a view of the message's own bytes where it holds such; organised rows follow
            each other.
        T_frame_points: Pose of the points in ``frame``; only Foxglove's clouds have another than identity.
        notes: What was left out or corrected to read it, a sentence each.
    """

    stamp_ns: int
    frame: str
    points: NDArray[np.void]
    T_frame_points: Transform = field(default_factory=lambda: np.eye(4))
    notes: Sequence[str] = ()


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


@dataclass(frozen=True, slots=True, eq=False)
class FixMessage:
    """A fix of a GNSS receiver (sensor_msgs/NavSatFix, gps_common/GPSFix).

    Attributes:
        stamp_ns: Time of the fix.
        frame: The antenna's frame.
        status: As of ``mapper.sensing.gnss.NO_FIX``.
        geodetic: (3,) latitude and longitude in degrees, metres above the ellipsoid.
        covariance_enu: (3, 3) m²; NaN where its type is unknown.
    """

    stamp_ns: int
    frame: str
    status: int
    geodetic: Array
    covariance_enu: Array


@dataclass(frozen=True, slots=True)
class SentenceMessage:
    """A sentence of a GNSS receiver (nmea_msgs/Sentence), and when it was received."""

    stamp_ns: int
    frame: str
    sentence: str


ImageMessage = PixelsMessage | FileMessage
Message = (
    ImageMessage
    | CameraMessage
    | CloudMessage
    | ImuMessage
    | FixMessage
    | SentenceMessage
    | list[PoseMessage]
)


def frame_of(message: Message | None) -> str:
    """Return the coordinate frame that a message names, without the slash that ROS 1 once put before it."""
    return "" if message is None or isinstance(message, list) else message.frame.lstrip("/")


PIXELS = frozenset({"sensor_msgs/msg/Image", "foxglove.RawImage"})
FILES = frozenset({"sensor_msgs/msg/CompressedImage", "foxglove.CompressedImage"})
IMAGES = PIXELS | FILES
CAMERAS = frozenset({"sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration"})
LIVOX = frozenset({"livox_ros_driver/msg/CustomMsg"})
VELODYNE = frozenset({"velodyne_msgs/msg/VelodyneScan"})
DRIVER_CLOUDS = LIVOX | VELODYNE
OUSTER_PACKETS = frozenset(
    f"{package}/msg/PacketMsg" for package in ("ouster_ros", "ouster_sensor_msgs", "ouster_msgs")
)
LASERS = frozenset({"sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan", "foxglove.LaserScan"})
CLOUDS = (
    frozenset({"sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/PointCloud", "foxglove.PointCloud"})
    | DRIVER_CLOUDS
    | LASERS
)
IMUS = frozenset({"sensor_msgs/msg/Imu"})
SENTENCES = frozenset({"nmea_msgs/msg/Sentence"})
GPS_FIXES = frozenset({"gps_common/msg/GPSFix", "gps_msgs/msg/GPSFix"})
FIXES = frozenset({"sensor_msgs/msg/NavSatFix"}) | GPS_FIXES | SENTENCES
ODOMETRY = frozenset({"nav_msgs/msg/Odometry"})
POSES = ODOMETRY | frozenset(
    {
        "geometry_msgs/msg/PointStamped",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
        "foxglove.PoseInFrame",
    }
)
TRANSFORMS = frozenset(
    {"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", "foxglove.FrameTransform", "foxglove.FrameTransforms"}
)
EXTRINSICS = frozenset({"realsense2_camera_msgs/msg/Extrinsics", "realsense2_camera/msg/Extrinsics"})
STREAM_POSES = frozenset({"geometry_msgs/msg/Transform"})
WITH_HEADER = IMAGES | CAMERAS | CLOUDS | IMUS | FIXES | POSES | {"foxglove.FrameTransform"}
READ = WITH_HEADER | TRANSFORMS | EXTRINSICS | STREAM_POSES
SMALL = FIXES | POSES | TRANSFORMS | EXTRINSICS | STREAM_POSES
