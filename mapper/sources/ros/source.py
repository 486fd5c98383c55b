"""Logs of MCAP files and ROS bags."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.frames import NO_DISTORTION, Sensor
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.sources.base import FrameRef, Log
from mapper.sources.calibration import Calibration, configured
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.image_sizes import RecordedCamera, Size, recorded_camera
from mapper.sources.image_files.reading import FINE_UNITS_PER_M
from mapper.sources.image_folders.pairing import depth_offset_ns
from mapper.sources.point_times import relative_times_s, time_field
from mapper.sources.ros.entries import CloudEntry, rgbd_entry
from mapper.sources.ros.frame_tree import is_fixed
from mapper.sources.ros.image_messages import MILLIMETRES_PER_M, has_float_depth, size_of
from mapper.sources.ros.index import Series, why_unread
from mapper.sources.ros.message_order import ordered, paired
from mapper.sources.ros.messages import (
    READ,
    CameraMessage,
    CloudMessage,
    FileMessage,
    ImageMessage,
    Window,
    frame_of,
)
from mapper.sources.ros.reader import SAME_CLOCK_NS, RecordingReader
from mapper.sources.ros.topics import CameraTopics, Choice, choose, is_called_registered
from mapper.sources.undistorted import FISHEYE_MODELS, POLYNOMIAL_MODELS, Lens, UndistortedEntry

_SAME_LENS_RATIO = 0.01
_SAME_PLACE_M = 0.005
"""Colour cameras lie farther beside the depth camera, 15 mm at least; frames of one lens may be turned."""
_JPEG_START = b"\xff\xd8"


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """Frames of a recording: their stamps, how to make an entry of each, and the coordinate frame of all."""

    sensor: Sensor
    body: str
    stamps_ns: Stamps
    entry_at: Callable[[int], FrameRef]
    notes: Sequence[str]


def recording_log(reader: RecordingReader, config: SourceConfig) -> Log:
    """Return a recording as a log; no frame is decoded before its time.

    Raises:
        SourceError: Nothing in it can be mapped, a requested topic is missing, images do not
            pair, or the camera is unknown.
    """
    recording = reader.recording
    unread = [
        why_unread(recording, series)
        for series in reader.series.values()
        if series.topic.type in READ and series.topic.name not in reader.firsts
    ]
    problems = [*filter(None, unread), *recording.notes]
    try:
        choice = choose(reader.series, reader.firsts, config.topics, path=recording.path)
    except SourceError as error:
        raise SourceError("; ".join([str(error), *problems])) from None
    main = choice.frames.color if isinstance(choice.frames, CameraTopics) else choice.frames
    if len(main) > 1 and not np.ptp(main.stamps_ns):
        raise SourceError(
            f"{recording.path}: all {len(main)} messages of {main.topic.name} have the same stamp and the "
            "same time of recording: nothing tells when they were measured"
        )
    reader.follow_clock(main)
    choice, clock_notes = _on_clock_of(main, choice)
    if isinstance(choice.frames, CameraTopics):
        frames = _rgbd(reader, choice.frames, config)
    else:
        frames = _lidar(reader, choice.frames, config)
    truth, truth_notes = reader.truth(choice.truth, body=frames.body)
    accelerations, imu_notes = reader.accelerations(choice.imu, body=frames.body)
    gyroscope, gyroscope_notes = reader.gyroscope(choice.gyroscope, body=frames.body)
    imu_notes = list(dict.fromkeys([*imu_notes, *gyroscope_notes]))  # of one topic, the same order
    wheels, wheel_notes = reader.wheels(
        choice.wheels, body=frames.body, config=config.wheels, sensor=frames.sensor
    )
    return Log(
        path=recording.path,
        name=recording.path.resolve().stem,
        kind=recording.kind,
        sensor=frames.sensor,
        stamps_ns=frames.stamps_ns,
        entry_at=frames.entry_at,
        truth=truth,
        accelerations=accelerations,
        gyroscope=gyroscope,
        T_base_body=reader.mounting(frames.body),
        wheels=wheels,
        notes=[*choice.notes, *problems, *clock_notes, *frames.notes, *truth_notes, *wheel_notes, *imu_notes],
    )


def _on_clock_of(main: Series, choice: Choice) -> tuple[Choice, list[str]]:
    """Return the choice with the stamps of every topic on the clock of one, and notes on those moved."""
    notes: list[str] = []

    def moved(series: Series) -> Series:
        shift_ns = main.clock_ns - series.clock_ns
        spans = [(int(one.stamps_ns.min()), int(one.stamps_ns.max())) for one in (main, series)]
        overlap = spans[0][0] <= spans[1][1] and spans[1][0] <= spans[0][1]
        if abs(shift_ns) <= SAME_CLOCK_NS or overlap:
            return series
        notes.append(
            f"{series.topic.name}: its stamps are on another clock than those of {main.topic.name}: moved by "
            f"{shift_ns / NS_PER_S:.1f} s, as the times of recording say"
        )
        return replace(series, stamps_ns=series.stamps_ns + shift_ns)

    frames = choice.frames
    if isinstance(frames, CameraTopics):
        frames = replace(frames, depth=moved(frames.depth))
    others = (choice.imu, choice.gyroscope, choice.truth, choice.wheels)
    imu, gyroscope, truth, wheels = (one and moved(one) for one in others)
    return replace(choice, frames=frames, imu=imu, gyroscope=gyroscope, truth=truth, wheels=wheels), list(
        dict.fromkeys(notes)
    )


def _rgbd(reader: RecordingReader, topics: CameraTopics, config: SourceConfig) -> _Frames:
    if config.body_frame is not None:
        raise SourceError(
            f"{reader.recording.path}: source.body_frame={config.body_frame}: the body of RGB-D frames is "
            "the camera; leave it out, or choose clouds with source.topics.points=…"
        )
    color, depth = topics.color, topics.depth
    depth = replace(depth, stamps_ns=depth.stamps_ns + depth_offset_ns(config))
    where = f"{reader.recording.path}"
    i, j, notes = paired(color, depth, max_gap_s=config.max_pair_gap_s, where=where)
    first_color, first_depth = _first_image(reader, color), _first_image(reader, depth)
    camera = _camera(reader, topics, config)
    has_other = topics.own_info is not None and topics.own_info is not topics.info
    own = _camera(reader, replace(topics, info=topics.own_info), config) if has_other else camera
    _refuse_unregistered(reader, topics, own)
    notes += camera.notes()
    frame, depth_frame = frame_of(first_color), frame_of(first_depth)
    if config.topics.depth is None and not is_called_registered(depth.topic.name):
        _refuse_apart(reader, topics, frame, depth_frame)
    if frame != depth_frame:
        notes.append(f"depth in frame {depth_frame} is taken to be registered to colour in {frame}")
    factor = None if config.camera is None else config.camera.depth_factor
    float_units_per_m = (factor or 1.0) if has_float_depth(first_depth) else None
    units_per_m = (factor or MILLIMETRES_PER_M) if float_units_per_m is None else FINE_UNITS_PER_M
    is_jpeg = isinstance(first_color, FileMessage) and bytes(first_color.data[:2]) == _JPEG_START
    maps = None
    if camera.lens is not None:
        maps = camera.lens.maps(camera.camera)
        notes.append(f"the distortion {camera.lens.model} is taken out of the images as they are read")

    def entry_at(index: int) -> FrameRef:
        entry = rgbd_entry(
            reader.located(color, int(i[index])),
            reader.located(depth, int(j[index])),
            camera,
            units_per_m=units_per_m,
            float_units_per_m=float_units_per_m,
            colour_suffix=".jpg" if is_jpeg else ".png",
        )
        return entry if maps is None else UndistortedEntry(entry, maps)

    return _Frames("rgbd", frame, color.stamps_ns[i], entry_at, notes)


def _lidar(reader: RecordingReader, clouds: Series, config: SourceConfig) -> _Frames:
    i, notes = ordered(clouds)
    first = reader.firsts.get(clouds.topic.name)
    if isinstance(first, CloudMessage):
        notes += [f"{clouds.topic.name}: {note}" for note in first.notes]
        times = time_field(first.points.dtype.names or ())
        if times and relative_times_s(first.points[times], first.stamp_ns) is None:
            notes.append(f"{clouds.topic.name}: field {times} holds no times; scans are not deskewed")
    frame = frame_of(first)
    body, body_notes = _body_of(reader, frame, config, name=clouds.topic.name)
    notes += body_notes
    if "optical" in body:
        notes.append(f"points are in {body}, whose z looks forward; source.body_frame can take another")

    def entry_at(index: int) -> FrameRef:
        return CloudEntry(reader.located(clouds, int(i[index])), body, tree, config.cloud_scale)

    tree = reader.tree_of(body, frame)
    return _Frames("lidar", body, clouds.stamps_ns[i], entry_at, notes)


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
    if tree.find(body, frame) is None:
        raise SourceError(
            f"{path}: source.body_frame={body}: tf does not connect it to the clouds' frame {frame}; its "
            f"frames: {', '.join(tree.frames) or 'no frames'}"
        )
    if is_fixed(body) and body != frame:
        raise SourceError(
            f"{path}: source.body_frame={body}: it stays where it is while the sensor moves; want a frame "
            f"of the robot: {', '.join(one for one in tree.frames if not is_fixed(one))}"
        )
    return body, notes


def _refuse_apart(reader: RecordingReader, topics: CameraTopics, frame: str, depth_frame: str) -> None:
    """Refuse depth that tf places elsewhere than colour: its pixels show other points than colour's."""
    T_color_depth = reader.tree.find(frame, depth_frame)
    if T_color_depth is None:
        return
    apart_m = float(np.linalg.norm(T_color_depth[:3, 3]))
    if apart_m > _SAME_PLACE_M:
        name, color = topics.depth.topic.name, topics.color.topic.name
        raise SourceError(
            f"{reader.recording.path}: {name} is not registered to {color}: tf has its frame {depth_frame} "
            f"{apart_m * 1e3:.0f} mm from {frame}; record depth that is, such as aligned_depth_to_color, or "
            f"if it is all the same, --set source.topics.depth={name}"
        )


def _first_image(reader: RecordingReader, series: Series) -> ImageMessage:
    first = reader.firsts.get(series.topic.name)
    if not isinstance(first, ImageMessage):
        raise SourceError(
            f"{reader.recording.path}: none of the first images can be read: "
            f"{why_unread(reader.recording, series)}"
        )
    return first


def _camera(reader: RecordingReader, topics: CameraTopics, config: SourceConfig) -> RecordedCamera:
    """Return the frames' camera, by the colour camera's calibration: the user's, else the recording's."""
    name = topics.color.topic.name
    calibration = configured(config.camera)
    if calibration is None:
        info = topics.info and reader.firsts.get(topics.info.topic.name)
        if topics.info is None or not isinstance(info, CameraMessage):
            raise SourceError(
                f"{reader.recording.path}: no camera info for {name}; choose one with "
                "source.topics.camera_info=… or --set source.camera.fx_px=… and so on"
            )
        info = _windowed(info, _size(reader, topics.color))
        calibration = _calibration(info, is_rectified="rect" in name, name=topics.info.topic.name)
    return recorded_camera(
        calibration,
        colour_px=_size(reader, topics.color),
        depth_px=_size(reader, topics.depth),
        where=f"{reader.recording.path}: {name}, {topics.depth.topic.name}",
    )


def _size(reader: RecordingReader, images: Series) -> Size:
    return size_of(_first_image(reader, images), where=f"{reader.recording.path}: {images.topic.name}")


def _windowed(info: CameraMessage, image_px: Size) -> CameraMessage:
    """Return the calibration of the part of the sensor that images of this size show, binned as they are."""
    window = info.window
    shown_px = (
        (window.width_px or info.width_px) // window.binning_x,
        (window.height_px or info.height_px) // window.binning_y,
    )
    if image_px != shown_px or image_px == (info.width_px, info.height_px):
        return info
    # The centre of pixel (0, 0) is at 0, so that of the first bin of n is at (n - 1) / 2.
    to_image = np.array(
        [
            [1.0 / window.binning_x, 0.0, (0.5 - window.x_px) / window.binning_x - 0.5],
            [0.0, 1.0 / window.binning_y, (0.5 - window.y_px) / window.binning_y - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    return replace(
        info,
        width_px=image_px[0],
        height_px=image_px[1],
        K=(to_image @ info.K.reshape(3, 3)).ravel() if info.K.size == 9 else info.K,
        P=(to_image @ info.P.reshape(3, 4)).ravel() if info.P.size == 12 else info.P,
        window=Window(),
    )


def _calibration(info: CameraMessage, *, is_rectified: bool, name: str) -> Calibration:
    """Return the intrinsics of raw images with their distortion, or of rectified ones without."""
    size_px = (info.width_px, info.height_px) if info.width_px and info.height_px else None
    P, K, D = info.P.tolist(), info.K.tolist(), info.D.tolist()
    if is_rectified and len(P) == 12 and P[0] > 0.0:
        return Calibration(name, P[0], P[5], P[2], P[6], size_px=size_px)
    if len(K) != 9 or not K[0] > 0.0:
        raise SourceError(
            f"{name}: the camera is not calibrated, K is {K}; --set source.camera.fx_px=… and so on"
        )
    if any(D) and (info.model not in POLYNOMIAL_MODELS or any(D[5:])):
        lens = Lens(info.model, D)
        if not lens.is_known:
            raise SourceError(
                f"{name}: distortion {info.model} with {len(D)} coefficients is not known; known are "
                f"{', '.join(sorted(POLYNOMIAL_MODELS | FISHEYE_MODELS))}: rectify the images, or --set "
                "source.camera.fx_px=… and so on"
            )
        return Calibration(name, K[0], K[4], K[2], K[5], lens=lens, size_px=size_px)
    k1, k2, p1, p2, k3 = (*D[:5], *NO_DISTORTION)[:5]
    return Calibration(name, K[0], K[4], K[2], K[5], distortion=(k1, k2, p1, p2, k3), size_px=size_px)


def _refuse_unregistered(reader: RecordingReader, topics: CameraTopics, recorded: RecordedCamera) -> None:
    """Refuse depth of another focal length than colour, if both are known: it is not on colour's pixels."""
    info = topics.depth_info and reader.firsts.get(topics.depth_info.topic.name)
    if not isinstance(info, CameraMessage) or info.K.shape != (9,) or not info.K[0] > 0.0:
        return
    width_px, height_px = recorded.depth_px
    info = _windowed(info, recorded.depth_px)
    fx_px = recorded.camera.fx_px
    if recorded.depth_px != recorded.colour_px:
        fx_px *= (info.width_px or width_px) / recorded.camera.width_px
    if abs(info.K[0] / fx_px - 1.0) > _SAME_LENS_RATIO:
        raise SourceError(
            f"{reader.recording.path}: {topics.depth.topic.name} ({width_px}×{height_px} px, focal length "
            f"{info.K[0]:.1f} px) is not registered to {topics.color.topic.name} (focal length {fx_px:.1f} "
            "px at that size); record depth that is, such as aligned_depth_to_color, or choose it with "
            "source.topics.depth=…"
        )
