"""Logs written as ROS messages: MCAP files (ROS 2) and ROS 1 bags."""

import heapq
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage, Image, PinholeCamera, RgbdFrame, Scan
from mapper.sources.base import FrameRef, ImageFiles, Log, Skipped
from mapper.sources.images import bytes_of, read_colour, read_depth_m
from mapper.sources.ros.image_messages import MILLIMETRES_PER_M
from mapper.sources.ros.topics import TRUTH, WHEELS

MessageKind = Literal["mcap", "bag"]

COLOR, DEPTH = "/camera/color", "/camera/aligned_depth_to_color"
POINTS, IMU = "/points", "/imu"

_CAMERA_FRAME, _LIDAR_FRAME, _IMU_FRAME = "camera_color_optical_frame", "lidar", "imu"
_WORLD, _ODOM = "world", "odom"
_FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}
_DEPTH_HEADER = bytes(12)  # compressedDepth's: no parameters are needed for 16 bits


class Written(NamedTuple):
    """A message to write."""

    stamp_ns: int
    topic: str
    type: str
    cdr: bytes


class MessageWriter(Protocol):
    """An open file of messages."""

    def write(self, message: Written) -> None:
        """Append a message."""
        ...


def write_recording(
    source: Log, out: Path, *, kind: MessageKind, on_progress: Callable[[int], None] | None = None
) -> list[Skipped]:
    """Write a log as one file of ROS messages and return the frames that could not be.

    Image files go in byte for byte where ROS has a message for them: colour as CompressedImage, 16-bit PNGs
    of millimetres as compressedDepth. Depth in other units goes in as float32 metres, which loses nothing.
    Of scans their points, times and colours are kept. Truth is on /ground_truth, wheel odometry, as poses of
    the sensor's own frame, on /wheel_odometry, and accelerations are on /imu.

    Args:
        source: What to write.
        out: File to make; its name ends as its kind does, by which it is recognised.
        kind: "mcap" (ROS 2) or "bag" (ROS 1).
        on_progress: Told how many frames are done, after each.

    Raises:
        SourceError: The file is there already or named for another format, or no frame can be read.
    """
    if out.suffix != f".{kind}":
        raise SourceError(f"{out}: give a name that ends in .{kind}, by which the log is recognised")
    if out.exists():
        raise SourceError(f"{out}: already there; give a file that does not exist yet")
    skipped: list[Skipped] = []
    first = _first_frame(source)
    with _writer(out, kind) as writer:
        frames = _frames(source, first, skipped, on_progress)
        for message in heapq.merge(
            frames,
            _truth(source),
            _wheels(source),
            _accelerations(source),
            key=lambda message: message.stamp_ns,
        ):
            writer.write(message)
    return skipped


def _writer(out: Path, kind: MessageKind) -> AbstractContextManager[MessageWriter]:
    if kind == "bag":
        from mapper.sources.ros.encode_ros import bag_writer

        return bag_writer(out)
    from mapper.sources.ros.mcap_file import mcap_writer

    return mcap_writer(out)


def _first_frame(source: Log) -> RgbdFrame | Scan:
    reason = "it has no frames"
    for entry in source.entries():
        try:
            return entry.load()
        except FrameError as error:
            reason = str(error)
    raise SourceError(f"{source.path}: no frame can be written: {reason}")


def _frames(
    source: Log,
    first: RgbdFrame | Scan,
    skipped: list[Skipped],
    on_progress: Callable[[int], None] | None,
) -> Iterator[Written]:
    depth_stamp_ns = None
    for done, entry in enumerate(source.entries(), start=1):
        try:
            if isinstance(first, Scan):
                yield _cloud(entry)
            else:
                colour, depth = _images(entry)
                if depth.stamp_ns != depth_stamp_ns:  # the nearest to two colour images is written once
                    depth_stamp_ns = depth.stamp_ns
                    yield depth
                    yield _camera_info(depth.stamp_ns, DEPTH, first.camera)
                yield colour
                yield _camera_info(colour.stamp_ns, COLOR, first.camera)
        except FrameError as error:
            skipped.append(Skipped(entry.stamp_ns, str(error)))
        if on_progress is not None:
            on_progress(done)


def _cloud(entry: FrameRef) -> Written:
    from mapper.sources.ros.encode_ros import cloud_message

    scan = entry.load()
    if not isinstance(scan, Scan):
        raise FrameError(f"frame {entry.stamp_ns}: an image among scans")
    return Written(
        scan.stamp_ns, POINTS, "sensor_msgs/msg/PointCloud2", cloud_message(scan, frame=_LIDAR_FRAME)
    )


def _images(entry: FrameRef) -> tuple[Written, Written]:
    """Return the messages of a frame's colour and depth image."""
    if entry.files is not None:
        return _colour_of_files(entry.stamp_ns, entry.files), _depth_of_files(entry.files)
    frame = entry.load()
    if isinstance(frame, Scan):
        raise FrameError(f"frame {entry.stamp_ns}: a scan among images")
    return (
        _image(entry.stamp_ns, COLOR, frame.rgb, encoding="rgb8"),
        _image(entry.stamp_ns, DEPTH, frame.depth_m, encoding="32FC1"),
    )


def _colour_of_files(stamp_ns: int, files: ImageFiles) -> Written:
    format_ = _FORMATS.get(files.colour.suffix.lower())
    if format_ is None:
        return _image(stamp_ns, COLOR, read_colour(files.colour), encoding="rgb8")
    return _file(stamp_ns, f"{COLOR}/image_raw/compressed", bytes_of(files.colour), format_=format_)


def _depth_of_files(files: ImageFiles) -> Written:
    stamp_ns = files.depth_stamp_ns
    if files.depth_units_per_m != MILLIMETRES_PER_M or files.depth.suffix.lower() != ".png":
        return _image(stamp_ns, DEPTH, read_depth_m(files.depth, files.depth_units_per_m), encoding="32FC1")
    topic = f"{DEPTH}/image_raw/compressedDepth"
    data = _DEPTH_HEADER + bytes_of(files.depth)
    return _file(stamp_ns, topic, data, format_="16UC1; compressedDepth png")


def _image(stamp_ns: int, folder: str, pixels: Image | DepthImage, *, encoding: str) -> Written:
    from mapper.sources.ros.encode_ros import image_message

    cdr = image_message(stamp_ns, pixels, encoding=encoding, frame=_CAMERA_FRAME)
    return Written(stamp_ns, f"{folder}/image_raw", "sensor_msgs/msg/Image", cdr)


def _file(stamp_ns: int, topic: str, data: bytes, *, format_: str) -> Written:
    from mapper.sources.ros.encode_ros import compressed_image_message

    cdr = compressed_image_message(stamp_ns, data, format_=format_, frame=_CAMERA_FRAME)
    return Written(stamp_ns, topic, "sensor_msgs/msg/CompressedImage", cdr)


def _camera_info(stamp_ns: int, folder: str, camera: PinholeCamera) -> Written:
    from mapper.sources.ros.encode_ros import camera_info_message

    cdr = camera_info_message(stamp_ns, camera, frame=_CAMERA_FRAME)
    return Written(stamp_ns, f"{folder}/camera_info", "sensor_msgs/msg/CameraInfo", cdr)


def _truth(source: Log) -> Iterator[Written]:
    from mapper.sources.ros.encode_ros import pose_message

    if source.truth is not None:
        for stamp_ns, T in zip(source.truth.stamps_ns.tolist(), source.truth.T_world_body, strict=True):
            cdr = pose_message(stamp_ns, T, frame=_WORLD)
            yield Written(stamp_ns, TRUTH, "geometry_msgs/msg/PoseStamped", cdr)


def _wheels(source: Log) -> Iterator[Written]:
    from mapper.sources.ros.encode_ros import odometry_message

    if source.wheels is not None:
        body = _LIDAR_FRAME if source.sensor == "lidar" else _CAMERA_FRAME
        for stamp_ns, T in zip(source.wheels.stamps_ns.tolist(), source.wheels.T_world_body, strict=True):
            cdr = odometry_message(stamp_ns, T, frame=_ODOM, child=body)
            yield Written(stamp_ns, WHEELS, "nav_msgs/msg/Odometry", cdr)


def _accelerations(source: Log) -> Iterator[Written]:
    from mapper.sources.ros.encode_ros import imu_message

    if (told := source.accelerations) is not None:
        for stamp_ns, reading in zip(told.stamps_ns.tolist(), told.acceleration_mps2, strict=True):
            cdr = imu_message(stamp_ns, reading, frame=_IMU_FRAME)
            yield Written(stamp_ns, IMU, "sensor_msgs/msg/Imu", cdr)
