"""Cameras of a recording's images: the calibration of colour's, and depth's where it is another."""

from dataclasses import replace

import numpy as np

from mapper.core.errors import FrameError, SourceError, listed
from mapper.core.frames import NO_DISTORTION, Image
from mapper.core.geometry import Transform, angle_between, inverse
from mapper.core.rotations import row_of_pose
from mapper.sources.base import CameraImages
from mapper.sources.calibration import (
    Calibration,
    DepthCamera,
    configured,
    configured_depth_intrinsics,
    configured_depth_pose,
)
from mapper.sources.calibration_file import calibration_files, read_calibration
from mapper.sources.config import CameraConfig
from mapper.sources.image_files.image_sizes import Size, is_same_view, recorded_camera
from mapper.sources.lens import FISHEYE_MODELS, POLYNOMIAL_MODELS, Lens, lens_model
from mapper.sources.ros.image_messages import image_of, size_of, unused_bits
from mapper.sources.ros.message_index import Series
from mapper.sources.ros.message_order import ordered
from mapper.sources.ros.messages import CAMERAS, EXTRINSICS, CameraMessage, ImageMessage, Window, frame_of
from mapper.sources.ros.reader import RecordingReader
from mapper.sources.ros.topic_ranks import is_called_rectified, is_called_registered, shared_namespaces
from mapper.sources.ros.topics import CameraTopics, ImageTopics
from mapper.sources.text import pose_from_numbers

_LOOKED_AT = 8
"""Calibrations, spread over the recording, that should be the same."""
_SAME_LENS_RATIO = 0.01
_SAME_PLACE_M = 0.005
"""Colour cameras lie farther beside the depth camera, 14 mm at least; frames of one lens may be turned."""
_MOST_TURNED_DEG = 30.0
"""Angle between frames of two cameras that show the same: an Azure Kinect's are 6° apart, but frames of which
one is no optical frame 90° or 120°."""
_SAME_POSE_M = 0.001
_SAME_POSE_DEG = 0.1
_SETTING = "--set source.camera.depth_in_color=[x,y,z,qx,qy,qz,qw]"


def calibrate(
    reader: RecordingReader,
    topics: CameraTopics,
    config: CameraConfig | None,
    *,
    frames: tuple[str, str],
    colour_px: Size,
    depth_px: Size,
) -> tuple[Calibration, list[str]]:
    """Return the colour camera's calibration, with the depth camera if it is another, and notes.

    Args:
        reader: The recording.
        topics: Its images and their calibrations.
        config: The user's settings of both cameras, which go before the recording's.
        frames: Coordinate frames of the colour and the depth images.
        colour_px: Size of the colour images.
        depth_px: Size of the depth images.

    Raises:
        SourceError: The colour camera's intrinsics are unknown or of an unknown lens, or depth is not
            registered to colour and its intrinsics are unknown.
    """
    calibration = _colour_calibration(reader, topics, topics.info, config, colour_px)
    own = calibration
    if topics.own_info is not None and topics.own_info is not topics.info:
        own = _colour_calibration(reader, topics, topics.own_info, config, colour_px)
    depth, notes = _depth_camera(reader, topics, own, config, frames, colour_px, depth_px)
    if configured(config) is None and calibration.origin not in reader.series:
        notes.append(f"{topics.color.topic.name}: no camera info; intrinsics of {calibration.origin}")
    elif topics.info is not None and configured(config) is None:
        notes += _doubts_about(reader, topics.info, images_frame=frames[0])
    if depth is not None:
        return replace(calibration, depth=depth), notes
    if frames[0] != frames[1]:
        notes.append(f"depth in frame {frames[1]} is taken to be registered to colour in {frames[0]}")
    return calibration, notes


def _doubts_about(reader: RecordingReader, infos: Series, *, images_frame: str) -> list[str]:
    """Return notes on calibrations that change during the recording, or are of another coordinate frame."""
    name, first, notes = infos.topic.name, _first_info(reader, infos), list[str]()
    if first is None:
        return notes
    if (frame := frame_of(first)) != images_frame and frame and images_frame:
        notes.append(
            f"{name} is of frame {frame}, colour images of {images_frame}: is it theirs? "
            "source.topics.camera_info=… names another"
        )
    for info in reader.spread_messages(infos, most=_LOOKED_AT):
        if not isinstance(info, CameraMessage) or not info.K[:1].any() or info.K.shape != first.K.shape:
            continue
        if np.abs(info.K - first.K).max() > _SAME_LENS_RATIO * np.abs(first.K).max():
            notes.append(
                f"{name}: the intrinsics change from {_numbers(first)} to {_numbers(info)}; the first are "
                "used: map the parts apart (source.first_frame, source.last_frame) with those of each in "
                "source.camera"
            )
            break
    return notes


def _numbers(info: CameraMessage) -> str:
    return ", ".join(f"{value:g}" for value in info.K.ravel()[[0, 4, 2, 5]])


def images_beside(reader: RecordingReader, topics: ImageTopics, *, body: str) -> CameraImages | str:
    """Return the images of a camera beside a LiDAR; why there are none without its pose or calibration."""
    images, name = topics.images, topics.images.topic.name
    first, info = reader.firsts.get(name), _first_info(reader, topics.info)
    T_body_camera = reader.tree.find(body, frame_of(first))
    if not isinstance(first, ImageMessage) or info is None or T_body_camera is None:
        return f"{name}: colours no points, as tf does not say where {frame_of(first)} is on {body}"
    try:
        size_px, shift = size_of(first, where=name), unused_bits(first, where=name)
        calibration = calibration_of(
            info, size_px, is_rectified=is_called_rectified(name), name=topics.info.topic.name
        )
        recorded = recorded_camera(calibration, colour_px=size_px, depth_px=size_px, where=name)
    except (SourceError, FrameError) as error:
        return f"{name}: colours no points: {error}"
    order, _ = ordered(images)

    def image_at(index: int) -> Image:
        located = reader.located(images, int(order[index]))
        return recorded.image(
            image_of(located.image(), colour=True, shift=shift, where=f"{located}"), f"{located}"
        )

    return CameraImages(name, images.stamps_ns[order], recorded.camera, T_body_camera, image_at)


def _colour_calibration(
    reader: RecordingReader,
    topics: CameraTopics,
    series: Series | None,
    config: CameraConfig | None,
    colour_px: Size,
) -> Calibration:
    """Return the colour camera's intrinsics: the user's, the recording's, or those of a file beside it."""
    chosen = configured(config)
    if chosen is not None:
        return chosen
    name, path = topics.color.topic.name, reader.recording.path
    info = _first_info(reader, series)
    if info is None or not info.K.any():
        files, first_counts = calibration_files(path if path.is_dir() else path.parent)
        if first_counts:
            return read_calibration(files[0])
    if series is None or info is None:
        infos = [one for one in reader.series if reader.series[one].topic.type in CAMERAS]
        others = f" of {listed(infos)}" if infos else ""
        raise SourceError(
            f"{path}: no camera info for {name}; choose one{others} with source.topics.camera_info=…, "
            "put a calibration.toml or camera.yaml beside it, or --set source.camera.fx_px=… and so on"
        )
    return calibration_of(info, colour_px, is_rectified=is_called_rectified(name), name=series.topic.name)


def _depth_camera(
    reader: RecordingReader,
    topics: CameraTopics,
    color: Calibration,
    config: CameraConfig | None,
    frames: tuple[str, str],
    colour_px: Size,
    depth_px: Size,
) -> tuple[DepthCamera | None, list[str]]:
    """Return the depth camera, None if depth is registered to colour, and notes.

    Its pose is None where the recording does not state it.
    """
    name, color_name = topics.depth.topic.name, topics.color.topic.name
    info = _first_info(reader, topics.depth_info)
    info = _windowed(info, depth_px) if info is not None and info.K.shape == (9,) and info.K[0] > 0 else None
    intrinsics, T_color_depth = configured_depth_intrinsics(config), configured_depth_pose(config)
    origin, notes = "source.camera.depth_in_color", list[str]()
    is_apart = T_color_depth is not None and not _is_same_pose(T_color_depth, np.eye(4))
    if T_color_depth is None:
        T_color_depth, origin, notes = _recorded_pose(reader, topics, frames)
        is_apart = _apart_m(T_color_depth) > _SAME_PLACE_M and not is_called_registered(name)
    width_px, fx_px = depth_px[0], None if intrinsics is None else intrinsics.fx_px
    if fx_px is None and info is not None:
        width_px, fx_px = info.width_px or width_px, float(info.K[0])
    color_fx_px = color.fx_px * width_px / (color.size_px or colour_px)[0]
    is_other_view = fx_px is not None and not (
        abs(fx_px / color_fx_px - 1.0) <= _SAME_LENS_RATIO and is_same_view(colour_px, depth_px)
    )
    if not (is_apart or is_other_view):
        return None, []
    if intrinsics is None and info is not None and topics.depth_info is not None:
        intrinsics = _calibration(
            info, is_rectified=is_called_rectified(name), name=topics.depth_info.topic.name
        )
    if is_other_view:
        size = f"{depth_px[0]}×{depth_px[1]} px"
        why = (
            f"{name} ({size}, focal length {fx_px:.1f} px) is not registered to {color_name} "
            f"(focal length {color_fx_px:.1f} px at that size)"
        )
    else:
        apart_mm = _apart_m(T_color_depth) * 1e3
        why = f"{name} is not registered to {color_name}, {apart_mm:.0f} mm beside it by {origin}"
    if intrinsics is None:
        missing = "its intrinsics are not in the log: --set source.camera.depth_intrinsics_px=[fx,fy,cx,cy]"
    elif (turned_deg := _turned_deg(np.eye(4), T_color_depth)) > _MOST_TURNED_DEG:
        missing = f"{origin} turns it by {turned_deg:.0f}°, so one frame is no optical one: {_SETTING}"
    else:
        return DepthCamera(intrinsics, T_color_depth, why if T_color_depth is None else origin), notes
    raise SourceError(f"{reader.recording.path}: {why}; {missing}")


def _apart_m(T_color_depth: Transform | None) -> float:
    return 0.0 if T_color_depth is None else float(np.linalg.norm(T_color_depth[:3, 3]))


def _recorded_pose(
    reader: RecordingReader, topics: CameraTopics, frames: tuple[str, str]
) -> tuple[Transform | None, str, list[str]]:
    """Return T_color_depth by tf, else by RealSense's own topics, its source, and a note if these differ."""
    color_frame, depth_frame = frames
    if color_frame == depth_frame:  # the driver's topics are about its own depth images, not these
        return *_pose_of_streams(reader, topics), []
    of_topic, topic = _pose_of_topic(reader, topics.color.topic.name)
    of_tf = reader.tree.find(color_frame, depth_frame)
    if of_tf is None:
        return of_topic, topic, []
    notes = []
    if of_topic is not None and not _is_same_pose(of_tf, of_topic):
        numbers = ",".join(f"{number:.5g}" for number in row_of_pose(of_topic))
        notes.append(
            f"{topic} has another pose of the depth camera than tf, which is used; if colours lie beside the "
            f"things: --set source.camera.depth_in_color=[{numbers}]"
        )
    return of_tf, "tf", notes


def _pose_of_topic(reader: RecordingReader, color: str) -> tuple[Transform | None, str]:
    """Return T_color_depth of the topic …/depth_to_color that is nearest to colour's, and its name."""
    names = [
        name
        for name, series in reader.series.items()
        if series.topic.type in EXTRINSICS and name.endswith("/depth_to_color")
    ]
    name = max(names, key=lambda one: shared_namespaces(one, color), default="")
    return _stated_pose(reader, name), name


def _pose_of_streams(reader: RecordingReader, topics: CameraTopics) -> tuple[Transform | None, str]:
    """Return T_color_depth of realsense-viewer's recordings, and its sources.

    Beside …/Depth_0/image/data, …/Depth_0/tf/0 maps points of a reference, the same of all streams, to the
    stream's frame (librealsense, ros_writer::write_extrinsics).
    """
    names, poses = [], []
    for series in (topics.color, topics.depth):
        stream = f"{series.topic.name.removesuffix('/image/data')}/tf/"
        names.append(next((name for name in reader.series if name.startswith(stream)), ""))
        poses.append(_stated_pose(reader, names[-1]))
    T_color_reference, T_depth_reference = poses
    if T_color_reference is None or T_depth_reference is None:
        return None, ""
    return T_color_reference @ inverse(T_depth_reference), " and ".join(names)


def _stated_pose(reader: RecordingReader, name: str) -> Transform | None:
    """Return the pose in the first message of a topic; None without one."""
    message = reader.firsts.get(name)
    return pose_from_numbers(np.array(message[0].numbers)) if isinstance(message, list) and message else None


def _is_same_pose(T_a: Transform, T_b: Transform) -> bool:
    apart_m = np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])
    return bool(apart_m < _SAME_POSE_M) and _turned_deg(T_a, T_b) < _SAME_POSE_DEG


def _turned_deg(T_a: Transform, T_b: Transform | None) -> float:
    return 0.0 if T_b is None else float(np.degrees(angle_between(T_a[:3, :3], T_b[:3, :3])))


def _first_info(reader: RecordingReader, series: Series | None) -> CameraMessage | None:
    info = series and reader.firsts.get(series.topic.name)
    if not isinstance(info, CameraMessage):
        return None
    if info.K.size == 9 and not info.K.any() and info.P.size == 12 and not info.D.any():
        return replace(info, K=info.P.reshape(3, 4)[:, :3].ravel())  # of drivers of rectified images
    return info


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


def calibration_of(info: CameraMessage, image_px: Size, *, is_rectified: bool, name: str) -> Calibration:
    """Return the intrinsics of raw images with their distortion, or of rectified ones without.

    Args:
        info: The camera's calibration.
        image_px: Size of the images, which may be binned or a part of the sensor.
        is_rectified: Whether the images are rectified.
        name: Topic, for messages.

    Raises:
        SourceError: The camera is not calibrated, or its lens is unknown.
    """
    return _calibration(_windowed(info, image_px), is_rectified=is_rectified, name=name)


def _calibration(info: CameraMessage, *, is_rectified: bool, name: str) -> Calibration:
    size_px = (info.width_px, info.height_px) if info.width_px and info.height_px else None
    P, K, D = info.P.tolist(), info.K.tolist(), info.D.tolist()
    if is_rectified and len(P) == 12 and P[0] > 0.0:
        return Calibration(name, P[0], P[5], P[2], P[6], size_px=size_px)
    if len(K) != 9 or not K[0] > 0.0:
        raise SourceError(
            f"{name}: the camera is not calibrated, K is {K}; --set source.camera.fx_px=… and so on"
        )
    if is_rectified:
        return Calibration(name, K[0], K[4], K[2], K[5], size_px=size_px)
    model = lens_model(info.model, len(D))
    if any(D) and (model not in POLYNOMIAL_MODELS or any(D[5:])):
        lens = Lens(model, D)
        if not lens.is_known:
            raise SourceError(
                f"{name}: distortion {info.model!r} with {len(D)} coefficients is not known; known are "
                f"{', '.join(sorted(POLYNOMIAL_MODELS | FISHEYE_MODELS))}: rectify the images, or --set "
                "source.camera.fx_px=… and so on"
            )
        return Calibration(name, K[0], K[4], K[2], K[5], lens=lens, size_px=size_px)
    k1, k2, p1, p2, k3 = (*D[:5], *NO_DISTORTION)[:5]
    return Calibration(name, K[0], K[4], K[2], K[5], distortion=(k1, k2, p1, p2, k3), size_px=size_px)
