"""Logs written as files of ROS messages."""

import heapq
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.geometry import transform
from mapper.core.units import MM_PER_M
from mapper.sources.base import FrameRef, ImageFiles, Log, Skipped
from mapper.sources.image_files.reading import image_bytes, read_colour, read_depth_m
from mapper.sources.ros.encode_ros import (
    SerializedMessage,
    camera_info_message,
    cloud_message,
    compressed_image_message,
    fix_message,
    image_message,
    imu_message,
    odometry_message,
    pose_message,
    transforms_message,
)
from mapper.sources.ros.image_messages import DEPTH_HEADER
from mapper.sources.ros.message_writers import RecordingKind, write_recording_file
from mapper.sources.ros.topics import TRUTH, WHEELS

COLOR, DEPTH = "/camera/color", "/camera/aligned_depth_to_color"
POINTS, IMU, GYROSCOPE, FIX = "/points", "/imu", "/gyroscope", "/fix"

_CAMERA_FRAME, _LIDAR_FRAME, _IMU_FRAME = "camera_color_optical_frame", "lidar", "imu"
_ANTENNA_FRAME = "gnss"
_WORLD, _ODOM = "world", "odom"
_FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}


def write_recording(
    source: Log, out: Path, *, kind: RecordingKind, on_progress: Callable[[int], None] | None = None
) -> list[Skipped]:
    """Write a log as one file of ROS messages and return the frames that could not be written.

    Image files are copied byte for byte where ROS has a message for them: colour as CompressedImage, 16-bit
    PNGs of millimetres as compressedDepth. Depth in other units is written as float32 metres, which loses
    nothing. Of scans, points, intensities, times and colours are written. Truth is on /ground_truth, wheel
    odometry, as poses of the sensor's own frame, on /wheel_odometry, accelerations and angular velocities on
    /imu, or the latter on /gyroscope where their times differ, GNSS fixes on /fix, the antenna, if known, in
    /tf_static.

    Args:
        source: Log that is written.
        out: File to make; its name ends as its kind does, by which it is recognised.
        kind: "mcap" (ROS 2) or "bag" (ROS 1).
        on_progress: Called with the number of frames done, after each.

    Raises:
        SourceError: The file is there already or named for another format, or no frame can be read.
    """
    if out.suffix != f".{kind}":
        raise SourceError(f"{out}: give a name that ends in .{kind}, by which the log is recognised")
    if out.exists():
        raise SourceError(f"{out}: already there; give a file that does not exist yet")
    skipped: list[Skipped] = []
    first = _first_frame(source)
    frames = _frames(source, first, skipped, on_progress)
    readings = _truth(source), _wheels(source), _imu(source), _fixes(source)
    messages = heapq.merge(frames, *readings, key=lambda message: message.stamp_ns)
    write_recording_file(out, messages, kind=kind)
    return skipped


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
) -> Iterator[SerializedMessage]:
    depth_stamp_ns = None
    for done, entry in enumerate(source.entries(), start=1):
        try:
            if isinstance(first, Scan):
                yield _not_early(_cloud(entry))
            else:
                colour, depth = map(_not_early, _images(entry))
                colour_camera, depth_camera = _cameras(first.camera, entry.files)
                if depth.stamp_ns != depth_stamp_ns:  # the nearest to two colour images is written once
                    depth_stamp_ns = depth.stamp_ns
                    yield depth
                    yield camera_info_message(
                        depth.stamp_ns, f"{DEPTH}/camera_info", depth_camera, frame=_CAMERA_FRAME
                    )
                yield colour
                yield camera_info_message(
                    colour.stamp_ns, f"{COLOR}/camera_info", colour_camera, frame=_CAMERA_FRAME
                )
        except FrameError as error:
            skipped.append(Skipped(entry.stamp_ns, str(error)))
        if on_progress is not None:
            on_progress(done)


def _not_early(message: SerializedMessage) -> SerializedMessage:
    if message.stamp_ns < 0:
        raise FrameError(f"stamp {message.stamp_ns / 1e9:.3f} s: no recording can be before the time 0")
    return message


def _cloud(entry: FrameRef) -> SerializedMessage:
    scan = entry.load()
    if not isinstance(scan, Scan):
        raise FrameError(f"frame {entry.stamp_ns}: an image among scans")
    return cloud_message(POINTS, scan, frame=_LIDAR_FRAME)


def _images(entry: FrameRef) -> tuple[SerializedMessage, SerializedMessage]:
    """Return the messages of a frame's colour and depth image."""
    if (files := entry.files) is not None:
        return _colour_of_files(entry.stamp_ns, files), _depth_of_files(entry.depth_stamp_ns, files)
    frame = entry.load()
    if isinstance(frame, Scan):
        raise FrameError(f"frame {entry.stamp_ns}: a scan among images")
    return (
        image_message(entry.stamp_ns, f"{COLOR}/image_raw", frame.rgb, encoding="rgb8", frame=_CAMERA_FRAME),
        image_message(
            frame.depth_stamp_ns, f"{DEPTH}/image_raw", frame.depth_m, encoding="32FC1", frame=_CAMERA_FRAME
        ),
    )


def _cameras(camera: PinholeCamera, files: ImageFiles | None) -> tuple[PinholeCamera, PinholeCamera]:
    """Return the cameras of a frame's colour and depth image in the sizes in which they are written."""
    sizes_px = (None, None) if files is None else (files.colour_px, files.depth_px)
    colour, depth = (camera if px is None else camera.resized(*px) for px in sizes_px)
    return colour, depth


def _colour_of_files(stamp_ns: int, files: ImageFiles) -> SerializedMessage:
    topic = f"{COLOR}/image_raw"
    format_ = _FORMATS.get(files.colour.suffix.lower())
    if format_ is None:
        rgb = read_colour(files.colour)
        return image_message(stamp_ns, topic, rgb, encoding="rgb8", frame=_CAMERA_FRAME)
    return compressed_image_message(
        stamp_ns, f"{topic}/compressed", image_bytes(files.colour), format_=format_, frame=_CAMERA_FRAME
    )


def _depth_of_files(stamp_ns: int, files: ImageFiles) -> SerializedMessage:
    topic = f"{DEPTH}/image_raw"
    if files.depth_units_per_m != MM_PER_M or files.depth.suffix.lower() != ".png":
        depth_m = read_depth_m(files.depth, files.depth_units_per_m)
        return image_message(stamp_ns, topic, depth_m, encoding="32FC1", frame=_CAMERA_FRAME)
    return compressed_image_message(
        stamp_ns,
        f"{topic}/compressedDepth",
        bytes(DEPTH_HEADER.size) + image_bytes(files.depth),
        format_="16UC1; compressedDepth png",
        frame=_CAMERA_FRAME,
    )


def _truth(source: Log) -> Iterator[SerializedMessage]:
    if source.truth is not None:
        for stamp_ns, T in source.truth[source.truth.stamps_ns >= 0].items():
            yield pose_message(stamp_ns, TRUTH, T, frame=_WORLD)


def _wheels(source: Log) -> Iterator[SerializedMessage]:
    if source.wheels is not None:
        body = _CAMERA_FRAME if source.sensor == "rgbd" else _LIDAR_FRAME
        for stamp_ns, T in source.wheels[source.wheels.stamps_ns >= 0].items():
            yield odometry_message(stamp_ns, WHEELS, T, frame=_ODOM, child=body)


def _imu(source: Log) -> Iterator[SerializedMessage]:
    felt, turned = source.accelerations, source.gyroscope
    body = _CAMERA_FRAME if source.sensor == "rgbd" else _LIDAR_FRAME
    if turned is not None and turned.R_body_imu is not None:  # in the body's axes, where no tf is needed
        turned = replace(turned, rates_radps=turned.rates_radps @ turned.R_body_imu.T)
    stamps_ns = np.empty(0, np.int64) if felt is None else felt.stamps_ns
    is_one = turned is not None and turned.R_body_imu is None and np.array_equal(stamps_ns, turned.stamps_ns)
    if felt is not None:
        if felt.place_body is not None and (stamps_ns >= 0).any():
            T_body_imu = transform(np.eye(3), felt.place_body)
            first_ns = int(stamps_ns[stamps_ns >= 0][0])
            yield transforms_message(first_ns, "/tf_static", [(body, _IMU_FRAME, T_body_imu)])
        for k in np.flatnonzero(stamps_ns >= 0).tolist():
            rates = turned.rates_radps[k] if turned is not None and is_one else None
            yield imu_message(
                int(stamps_ns[k]),
                IMU,
                rates_radps=rates,
                acceleration_mps2=felt.acceleration_mps2[k],
                frame=_IMU_FRAME,
            )
    if turned is not None and not is_one:
        frame = _IMU_FRAME if turned.R_body_imu is None else body
        for k in np.flatnonzero(turned.stamps_ns >= 0).tolist():
            yield imu_message(
                int(turned.stamps_ns[k]),
                GYROSCOPE,
                rates_radps=turned.rates_radps[k],
                acceleration_mps2=None,
                frame=frame,
            )


def _fixes(source: Log) -> Iterator[SerializedMessage]:
    if source.gnss is None:
        return
    body = _CAMERA_FRAME if source.sensor == "rgbd" else _LIDAR_FRAME
    fixes = source.gnss.of(source.gnss.stamps_ns >= 0)
    for k, stamp_ns in enumerate(fixes.stamps_ns.tolist()):
        if k == 0 and fixes.antenna_body is not None:
            T_body_antenna = transform(np.eye(3), fixes.antenna_body)
            yield transforms_message(stamp_ns, "/tf_static", [(body, _ANTENNA_FRAME, T_body_antenna)])
        yield fix_message(
            stamp_ns,
            FIX,
            geodetic=fixes.geodetic[k],
            covariance_enu=fixes.covariances_enu[k],
            status=int(fixes.status[k]),
            frame=_ANTENNA_FRAME,
        )


def early_readings(source: Log) -> dict[str, int]:
    """Return how many readings of each kind are from before the time 0, where no recording can be."""
    kinds = {
        "true poses": source.truth,
        "wheel readings": source.wheels,
        "accelerations": source.accelerations,
        "angular velocities": source.gyroscope,
        "GNSS fixes": source.gnss,
    }
    counts = {kind: int((held.stamps_ns < 0).sum()) for kind, held in kinds.items() if held is not None}
    return {kind: count for kind, count in counts.items() if count}
