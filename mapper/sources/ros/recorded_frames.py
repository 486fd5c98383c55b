"""Frames of a recording's sensors: RGB-D cameras, stereo pairs, LiDARs and 2D lasers, not decoded yet."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mapper.core.errors import SourceError, listed
from mapper.core.frames import Sensor
from mapper.core.timebase import Stamps
from mapper.core.units import MM_PER_M
from mapper.sources.base import FrameRef, Log
from mapper.sources.config import SourceConfig
from mapper.sources.depth_camera_pose import with_depth_pose
from mapper.sources.image_files.image_sizes import RecordedCamera, recorded_camera
from mapper.sources.image_files.reading import TUM_UNITS_PER_M
from mapper.sources.image_folders.pairing import depth_offset_ns
from mapper.sources.image_folders.rgbd import RgbdImages
from mapper.sources.laser_scan import MAX_TILT_RAD, tilt_rad
from mapper.sources.point_times import times_told
from mapper.sources.ros.cameras import calibrate
from mapper.sources.ros.cloud_messages import values_of_returns
from mapper.sources.ros.entries import Located, cloud_entry, read_image, rgbd_images, stereo_entry
from mapper.sources.ros.frame_tree import is_fixed
from mapper.sources.ros.image_messages import has_float_depth, size_of, unused_bits
from mapper.sources.ros.message_index import Series, why_unread
from mapper.sources.ros.message_order import ordered, paired
from mapper.sources.ros.messages import (
    LASERS,
    VELODYNE,
    CloudMessage,
    FileMessage,
    ImageMessage,
    Message,
    frame_of,
)
from mapper.sources.ros.reader import RecordingReader
from mapper.sources.ros.stereo_cameras import stereo_camera
from mapper.sources.ros.topics import CameraTopics, StereoTopics
from mapper.sources.stereo import refuse_settings
from mapper.sources.velodyne_packets import require_decoder

_JPEG_START = b"\xff\xd8"


def log_of_frames(
    reader: RecordingReader, topics: CameraTopics | StereoTopics | Series, config: SourceConfig
) -> Log:
    """Return the frames of one sensor of a recording, as a log that has nothing else yet.

    Raises:
        SourceError: They cannot be mapped, or their camera is unknown.
    """
    match topics:
        case CameraTopics():
            return _rgbd_log(reader, topics, config)
        case StereoTopics():
            return _stereo_log(reader, topics, config)
        case _:
            return _lidar_log(reader, topics, config)


def _log(
    reader: RecordingReader,
    sensor: Sensor,
    body: str,
    stamps_ns: Stamps,
    entry_at: Callable[[int], FrameRef],
    notes: Sequence[str],
) -> Log:
    recording = reader.recording
    return Log(
        path=recording.path,
        name=recording.path.resolve().stem,
        kind=recording.kind,
        sensor=sensor,
        stamps_ns=stamps_ns,
        entry_at=entry_at,
        body_frame=body,
        notes=notes,
    )


def _stereo_log(reader: RecordingReader, topics: StereoTopics, config: SourceConfig) -> Log:
    """Return the frames of a stereo pair, whose depth is computed as they are read."""
    refuse_settings(config.camera)
    left, right, where = topics.left, topics.right, f"{reader.recording.path}"
    i, j, notes = paired(left, right, max_gap_s=config.max_pair_gap_s, where=where)
    first = _first_image(reader, left)
    size_px = size_of(first, where=f"{where}: {left.topic.name}")
    shift = unused_bits(first, where=f"{where}: {left.topic.name}")
    camera = stereo_camera(reader, topics, size_px=size_px)
    recorded = recorded_camera(camera.calibration, colour_px=size_px, depth_px=size_px, where=where)

    def located(index: int) -> tuple[Located, Located]:
        return reader.located(left, int(i[index])), reader.located(right, int(j[index]))

    def entry_at(index: int) -> FrameRef:
        return stereo_entry(*located(index), camera, recorded, shift=shift)

    camera.refuse_exchanged(
        lambda k: [partial(read_image, one, shift=shift) for one in located(k)],
        len(i),
        f"{where}: {left.topic.name}",
    )
    notes.append(camera.note)
    log = _log(reader, "rgbd", frame_of(first), left.stamps_ns[i], entry_at, notes)
    return replace(log, depth_noise=camera.noise)


def _rgbd_log(reader: RecordingReader, topics: CameraTopics, config: SourceConfig) -> Log:
    """Return the frames of an RGB-D camera."""
    color, depth = topics.color, topics.depth
    depth = replace(depth, stamps_ns=depth.stamps_ns + depth_offset_ns(config))
    where = f"{reader.recording.path}"
    i, j, notes = paired(color, depth, max_gap_s=config.max_pair_gap_s, where=where)
    first_color, first_depth = _first_image(reader, color), _first_image(reader, depth)
    frame, depth_frame = frame_of(first_color), frame_of(first_depth)
    colour_px, depth_px = (
        size_of(first, where=f"{where}: {one.topic.name}")
        for one, first in ((color, first_color), (depth, first_depth))
    )
    calibration, camera_notes = calibrate(
        reader, topics, config.camera, frames=(frame, depth_frame), colour_px=colour_px, depth_px=depth_px
    )
    factor = None if config.camera is None else config.camera.depth_factor
    float_units_per_m = (factor or 1.0) if has_float_depth(first_depth) else None
    stated = factor or calibration.depth_units_per_m
    units_per_m = (stated or MM_PER_M) if float_units_per_m is None else TUM_UNITS_PER_M
    shift = unused_bits(first_color, where=f"{where}: {color.topic.name}")
    is_jpeg = isinstance(first_color, FileMessage) and bytes(first_color.data[:2]) == _JPEG_START

    def images_of(camera: RecordedCamera, index: int) -> RgbdImages:
        return rgbd_images(
            reader.located(color, int(i[index])),
            reader.located(depth, int(j[index])),
            camera,
            units_per_m=units_per_m,
            float_units_per_m=float_units_per_m,
            colour_suffix=".jpg" if is_jpeg else ".png",
            shift=shift,
        )

    camera_of = partial(
        recorded_camera,
        colour_px=colour_px,
        depth_px=depth_px,
        where=f"{where}: {color.topic.name}, {depth.topic.name}",
    )
    camera = camera_of(calibration)
    if calibration.needs_depth_pose:
        unplaced = partial(images_of, camera)
        calibration = with_depth_pose(
            calibration, camera, lambda index: unplaced(index).pair(), len(i), where=where
        )
        camera = camera_of(calibration)
    notes += [*camera_notes, *camera.notes(), *calibration.notes()]
    return _log(
        reader, "rgbd", frame, color.stamps_ns[i], lambda index: images_of(camera, index).entry(), notes
    )


def _lidar_log(reader: RecordingReader, clouds: Series, config: SourceConfig) -> Log:
    """Return the scans of a LiDAR or a 2D laser."""
    if clouds.topic.type in VELODYNE:
        require_decoder()
    i, notes = ordered(clouds)
    first = _first_of(reader, clouds)
    assert isinstance(first, CloudMessage)
    notes += [f"{clouds.topic.name}: {note}" for note in first.notes]
    has_stamp = first.stamp_ns in clouds.stamps_ns  # else the time of recording is taken
    stamp_ns = first.stamp_ns if has_stamp else int(clouds.stamps_ns[0])
    choices, time_notes = times_told(
        first.points.dtype.names or (), partial(values_of_returns, first.points), stamp_ns
    )
    notes += [f"{clouds.topic.name}: {note}" for note in time_notes]
    frame, is_planar = _usual_frame(reader, clouds, frame_of(first)), clouds.topic.type in LASERS
    if is_planar and config.body_frame is None:
        config = config.model_copy(update={"body_frame": reader.base_of(frame)})
    body, body_notes = _body_of(reader, frame, config, name=clouds.topic.name)
    notes += body_notes
    if is_planar:
        notes += _planar_notes(reader, frame, body, name=clouds.topic.name)
    if "optical" in body:
        notes.append(f"points are in {body}, whose z looks forward; source.body_frame can take another")

    def entry_at(index: int) -> FrameRef:
        cloud = reader.located(clouds, int(i[index]))
        return cloud_entry(cloud, body, tree, scale=config.cloud_scale, is_planar=is_planar)

    is_apart = np.array([reader.tree.find(body, one) is None for one in clouds.frames], np.bool_)
    if is_apart.any():
        left_out = is_apart[clouds.frame_numbers]
        names = listed(
            [one or "(no name)" for one, apart in zip(clouds.frames, is_apart, strict=True) if apart]
        )
        notes.append(
            f"{clouds.topic.name}: {left_out.sum()} of {len(clouds)} clouds are in frames that tf does not "
            f"connect to {body}; left out: {names}; record /tf_static too"
        )
        kept, seen = ~left_out[i], np.logical_or.accumulate
        # Before and after the others a part of the path is missing, so there they count as skipped.
        i = i[kept | ~seen(kept) | ~seen(kept[::-1])[::-1]]
    tree = reader.tree_of(body, frame)
    log = _log(reader, "lidar-2d" if is_planar else "lidar", body, clouds.stamps_ns[i], entry_at, notes)
    return replace(log, choices=[f"{clouds.topic.name}: {choice}" for choice in choices])


def _usual_frame(reader: RecordingReader, clouds: Series, first: str) -> str:
    """Return the frame of the first cloud, or of most clouds where tf does not connect the two."""
    if not clouds.frames:
        return first
    usual = clouds.frames[int(np.bincount(clouds.frame_numbers).argmax())]
    return first if reader.tree.find(usual, first) is not None else usual


def _planar_notes(reader: RecordingReader, frame: str, body: str, *, name: str) -> list[str]:
    """Return a note where a 2D laser's mounting is not stated.

    Raises:
        SourceError: Its plane is not that in which the body moves.
    """
    if body == frame:
        return [f"{name}: tf does not say where the robot carries {frame}, which is taken as the body"]
    T_body_laser = reader.tree.find(body, frame)
    assert T_body_laser is not None
    if (angle_rad := tilt_rad(T_body_laser)) > MAX_TILT_RAD:
        raise SourceError(
            f"{reader.recording.path}: {name}: by tf the laser's plane is tilted by "
            f"{np.degrees(angle_rad):.0f}° in {body}, want at most {np.degrees(MAX_TILT_RAD):.0f}°: the "
            f"robot does not drive in it; source.body_frame={frame} maps the scans in their own plane"
        )
    return []


def _body_of(
    reader: RecordingReader, frame: str, config: SourceConfig, *, name: str
) -> tuple[str, list[str]]:
    """Return the frame of the scans of clouds in a frame, and notes: the robot's where theirs moves in it.

    Raises:
        SourceError: The clouds' frame stays and tf does not say where the robot was, or tf does not connect
            the clouds' frame to the body's.
    """
    path, tree = reader.recording.path, reader.tree
    body, notes = config.body_frame or frame, []
    base = reader.base_of(frame) or (tree.carried_by(frame) if is_fixed(frame) else None)
    if config.body_frame is None and base is not None and tree.moves(base, frame):
        body = base
        notes.append(
            f"{name}: points in frame {frame}, which moves in {base} by tf, are turned into {base}; "
            "source.body_frame can take another"
        )
    elif config.body_frame is None and is_fixed(frame):
        raise SourceError(
            f"{path}: the points of {name} are in frame {frame}, which stays where it is while the sensor "
            "moves; build from the driver's own topic (source.topics.points), or if they are around the "
            f"sensor all the same, --set source.body_frame={frame}"
        )
    refuse_body_frame(reader, body, frame)
    return body, notes


def refuse_body_frame(reader: RecordingReader, body: str, frame: str) -> None:
    """Refuse a frame that tf does not connect to a sensor's, or that stays while the sensor moves.

    Raises:
        SourceError: It is such a frame.
    """
    path, tree = reader.recording.path, reader.tree
    if tree.find(body, frame) is None:
        raise SourceError(
            f"{path}: source.body_frame={body}: tf does not connect it to the sensor's frame {frame}; its "
            f"frames: {', '.join(tree.frames) or 'no frames'}"
        )
    if is_fixed(body) and body != frame:
        raise SourceError(
            f"{path}: source.body_frame={body}: it stays where it is while the sensor moves; want a frame "
            f"of the robot: {', '.join(one for one in tree.frames if not is_fixed(one))}"
        )


def _first_of(reader: RecordingReader, series: Series) -> Message:
    first = reader.firsts.get(series.topic.name)
    if first is None:
        raise SourceError(
            f"{reader.recording.path}: none of the first messages can be read: "
            f"{why_unread(reader.recording, series)}"
        )
    return first


def _first_image(reader: RecordingReader, series: Series) -> ImageMessage:
    first = _first_of(reader, series)
    assert isinstance(first, ImageMessage)
    return first
