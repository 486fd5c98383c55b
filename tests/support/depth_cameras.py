"""Logs of a depth camera beside the colour camera, made from logs whose depth is registered to colour."""

from pathlib import Path
from typing import Literal

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from mapper.core.frames import PinholeCamera, ray_table
from mapper.core.geometry import Transform, exp, inverse
from mapper.sources.base import Log
from mapper.sources.ros.encode_ros import SerializedMessage, camera_info_message
from tests.support.recordings import image, transforms, write_folder
from tests.support.tum_logs import FIRST_NS

BESIDE = exp(np.array([0.004, -0.007, 0.005]), np.array([0.015, 0.0002, 0.0003]))
"""T_color_depth of a RealSense D435: 15 mm apart, turned by half a degree."""
D435 = PinholeCamera(848, 480, 425.0, 425.0, 423.7, 238.9)

_SAMPLES = 2
_SAME_SURFACE = 0.05


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


def extrinsics(
    T_color_depth: Transform, *, topic: str = "/camera/extrinsics/depth_to_color"
) -> SerializedMessage:
    """The RealSense driver's message of a pose, whose rotation is stored column by column."""
    numbers = np.concatenate([T_color_depth[:3, :3].ravel(order="F"), T_color_depth[:3, 3]])
    cdr = b"\0\1\0\0" + numbers.astype("<f8").tobytes()
    return SerializedMessage(FIRST_NS, topic, "realsense2_camera_msgs/msg/Extrinsics", cdr)


def write_unregistered(
    folder: Path,
    log: Log,
    depth_camera: PinholeCamera = D435,
    T_color_depth: Transform = BESIDE,
    *,
    stated_in: Literal["tf", "topic"] | None = "tf",
    also_topic: Transform | None = None,
) -> None:
    """Write a log as the RealSense driver records it without alignment: a ROS 2 bag.

    Raw colour and depth in millimetres with a CameraInfo each, and the pose of the depth camera in
    /tf_static, or in the driver's own /camera/extrinsics/depth_to_color, or nowhere; ``also_topic`` is
    another pose for that topic.
    """
    color, depth = "camera_color_optical_frame", "camera_depth_optical_frame"
    messages = [transforms((color, depth, T_color_depth))] if stated_in == "tf" else []
    messages += [extrinsics(T_color_depth)] if stated_in == "topic" else []
    messages += [extrinsics(also_topic)] if also_topic is not None else []
    for entry in log.entries():
        frame = entry.load()
        depth_m = seen_from(frame.depth_m, frame.camera, depth_camera, T_color_depth)
        units = np.rint(depth_m * 1000.0).astype(np.uint16)
        color_ns = entry.stamp_ns
        depth_ns = color_ns + round(frame.depth_delay_s * 1e9)
        messages += [
            image(color_ns, "/camera/color/image_raw", frame.image, "rgb8", frame=color),
            camera_info_message(color_ns, "/camera/color/camera_info", frame.camera, frame=color),
            image(depth_ns, "/camera/depth/image_rect_raw", units, "16UC1", frame=depth),
            camera_info_message(depth_ns, "/camera/depth/camera_info", depth_camera, frame=depth),
        ]
    write_folder(Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP), messages)
