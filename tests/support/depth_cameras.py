"""Logs of a depth camera beside the colour camera, made from logs whose depth is registered to colour."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapper.core.frames import PinholeCamera, ray_table
from mapper.core.geometry import Transform, exp, inverse
from mapper.core.rotations import row_of_pose
from mapper.sources.base import Log

BESIDE = exp(np.array([0.004, -0.007, 0.005]), np.array([0.015, 0.0002, 0.0003]))
"""T_color_depth of a RealSense D435: 15 mm apart, turned by half a degree."""
D435 = PinholeCamera(848, 480, 425.0, 425.0, 423.7, 238.9)

_SAMPLES = 2
_SAME_SURFACE = 0.05
_EXTRINSICS = "float64[9] rotation\nfloat64[3] translation\n"


def seen_from(
    depth_m: np.ndarray, camera: PinholeCamera, other: PinholeCamera, T_camera_other: Transform
) -> np.ndarray:
    """Depth as another camera would measure it: of points twice as dense, in each pixel the nearest
    surface's closest to its middle."""
    points = _dense_points(depth_m, camera)
    T = inverse(T_camera_other)
    points = points @ T[:3, :3].T + T[:3, 3]
    points = points[points[:, 2] > 0.05]
    pixels = other.project(points)
    if any(other.distortion):
        pixels = other.distort(pixels)
    nearest = np.rint(pixels).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < (other.width_px, other.height_px))).all(axis=1)
    z, pixels, nearest = points[inside, 2], pixels[inside], nearest[inside]
    place = nearest[:, 1] * other.width_px + nearest[:, 0]
    front_m = np.full(other.width_px * other.height_px, np.inf)
    np.minimum.at(front_m, place, z)
    is_front = z <= front_m[place] * (1.0 + _SAME_SURFACE)
    z, place = z[is_front], place[is_front]
    off = ((pixels - nearest)[is_front] ** 2).sum(axis=1)
    keys = (off * 2.0**20).astype(np.int64) << 32 | np.arange(len(z))
    best = np.full(len(front_m), np.iinfo(np.int64).max)
    np.minimum.at(best, place, keys)
    seen = np.isfinite(front_m)
    found = np.zeros(len(front_m), np.float32)
    found[seen] = z[best[seen] & 0xFFFFFFFF]
    return found.reshape(other.height_px, other.width_px)


def _dense_points(depth_m: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    rays = ray_table(camera).astype(np.float64)
    with np.errstate(divide="ignore"):
        w = np.where(depth_m > 0.0, 1.0 / depth_m.astype(np.float64), 0.0)
    corners = np.stack([w[:-1, :-1], w[:-1, 1:], w[1:, :-1], w[1:, 1:]])
    whole = (corners.min(axis=0) > 0.0) & (corners.max(axis=0) <= corners.min(axis=0) * (1 + _SAME_SURFACE))
    dense = [np.dstack([rays, np.ones(w.shape)])[w > 0.0] / w[w > 0.0][:, None]]
    for a, b in np.ndindex(_SAMPLES, _SAMPLES):
        s, t = a / _SAMPLES, b / _SAMPLES
        if a or b:
            weights = ((1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t)
            slices = ((0, 0), (0, 1), (1, 0), (1, 1))
            inverse_m, ray = np.zeros(whole.shape), np.zeros((*whole.shape, 2))
            for weight, (i, j) in zip(weights, slices, strict=True):
                part = np.s_[i : i + whole.shape[0], j : j + whole.shape[1]]
                inverse_m += weight * w[part]
                ray += weight * rays[part]
            dense.append(np.dstack([ray, np.ones(whole.shape)])[whole] / inverse_m[whole][:, None])
    return np.concatenate(dense)


def write_unregistered(
    folder: Path,
    log: Log,
    depth_camera: PinholeCamera = D435,
    T_color_depth: Transform = BESIDE,
    *,
    is_in_tf: bool = True,
    also_topic: Transform | None = None,
) -> None:
    """Write a log as the RealSense driver records it without alignment: a ROS 2 bag, by rosbags alone.

    Raw colour and depth in millimetres with a CameraInfo each, and the pose of the depth camera in
    /tf_static, or else in the driver's own /camera/extrinsics/depth_to_color; ``also_topic`` is another
    pose for that topic.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_EXTRINSICS, "realsense2_camera_msgs/msg/Extrinsics"))
    types = store.types

    def header(stamp_ns: int, frame: str):
        time = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
        return types["std_msgs/msg/Header"](time, f"camera_{frame}_optical_frame")

    def image(stamp_ns: int, frame: str, pixels: np.ndarray, encoding: str):
        data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
        height, width = pixels.shape[:2]
        return types["sensor_msgs/msg/Image"](
            header(stamp_ns, frame), height, width, encoding, 0, len(data) // height, data
        )

    def info(stamp_ns: int, frame: str, camera: PinholeCamera):
        K, no_roi = camera.matrix, types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        P = np.column_stack([K, np.zeros(3)]).ravel()
        return types["sensor_msgs/msg/CameraInfo"](
            header(stamp_ns, frame), camera.height_px, camera.width_px, "plumb_bob",
            np.array(camera.distortion), K.ravel(), np.eye(3).ravel(), P, 0, 0, no_roi,
        )  # fmt: skip

    of_topic = also_topic if is_in_tf else T_color_depth
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}

        def write(topic: str, log_ns: int, message) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            data = store.serialize_cdr(message, message.__msgtype__)
            writer.write(connections[topic], log_ns, data)

        first_ns = int(log.stamps_ns[0])
        if is_in_tf:
            x, y, z, *q = row_of_pose(T_color_depth).tolist()
            pose = types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](x, y, z), types["geometry_msgs/msg/Quaternion"](*q)
            )
            stamped = types["geometry_msgs/msg/TransformStamped"](
                header(first_ns, "color"), "camera_depth_optical_frame", pose
            )
            write("/tf_static", first_ns, types["tf2_msgs/msg/TFMessage"]([stamped]))
        if of_topic is not None:  # its rotation is stored column by column
            R, t = of_topic[:3, :3], of_topic[:3, 3].copy()
            extrinsics = types["realsense2_camera_msgs/msg/Extrinsics"](R.ravel(order="F"), t)
            write("/camera/extrinsics/depth_to_color", first_ns, extrinsics)
        for entry in log.entries():
            frame = entry.load()
            depth_m = seen_from(frame.depth_m, frame.camera, depth_camera, T_color_depth)
            units = np.rint(depth_m * 1000.0).astype(np.uint16)
            color_ns = entry.stamp_ns
            depth_ns = color_ns + round(frame.depth_delay_s * 1e9)
            write("/camera/color/image_raw", color_ns, image(color_ns, "color", frame.image, "rgb8"))
            write("/camera/color/camera_info", color_ns, info(color_ns, "color", frame.camera))
            write("/camera/depth/image_rect_raw", depth_ns, image(depth_ns, "depth", units, "16UC1"))
            write("/camera/depth/camera_info", depth_ns, info(depth_ns, "depth", depth_camera))
