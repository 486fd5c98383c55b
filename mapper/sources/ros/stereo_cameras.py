"""Stereo cameras of a recording, by their calibrations and tf, or by Kalibr's file beside it."""

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array, inverse, nearest_rotation, transform
from mapper.sources.camera_chain import pair_beside
from mapper.sources.image_files.image_sizes import Size
from mapper.sources.ros.cameras import calibration_of
from mapper.sources.ros.message_index import Series
from mapper.sources.ros.messages import CameraMessage, frame_of
from mapper.sources.ros.reader import RecordingReader
from mapper.sources.ros.topic_ranks import is_called_rectified
from mapper.sources.ros.topics import StereoTopics
from mapper.sources.stereo import StereoCamera, rectified_pair, rectify


def stereo_camera(reader: RecordingReader, topics: StereoTopics, *, size_px: Size) -> StereoCamera:
    """Return the camera of a pair's frames: the rectified left one.

    The cameras' distance is that of their projections (CameraInfo's P), or else of tf; the images tell which
    is on the left. Those of a topic without "rect" in its name are raw, and are rectified. Without a
    calibrated CameraInfo of each, Kalibr's file counts.

    Raises:
        SourceError: A camera or its place is unknown, or the cameras do not lie side by side.
    """
    where, name = reader.recording.path, topics.left.topic.name
    left, right = (_info(reader, one) for one in (topics.left_info, topics.right_info))
    if left is None or right is None or topics.left_info is None or topics.right_info is None:
        folder = where if where.is_dir() else where.parent
        if (pair := pair_beside(folder, topics=(name, topics.right.topic.name))) is not None:
            T_left_right = inverse(pair[0].T_unit_camera) @ pair[1].T_unit_camera
            return rectify(pair[0].calibration, pair[1].calibration, T_left_right, size_px)
        missing = topics.left if left is None else topics.right
        raise SourceError(
            f"{where}: stereo images {name} and {topics.right.topic.name}: no calibration (camera info) "
            f"of {missing.topic.name}; record both, or put Kalibr's camchain.yaml beside the recording"
        )
    is_rectified = is_called_rectified(name)
    left_camera, right_camera = (
        calibration_of(info, size_px, is_rectified=is_rectified, name=series.topic.name)
        for info, series in ((left, topics.left_info), (right, topics.right_info))
    )
    along_m = [
        info.P[3] / info.P[0] if info.P.size == 12 and info.P[0] > 0.0 else 0.0 for info in (left, right)
    ]
    baseline_m = abs(along_m[0] - along_m[1])
    of_tf = reader.tree.find(
        *(frame_of(reader.firsts.get(one.topic.name)) for one in (topics.left, topics.right))
    )
    if baseline_m != 0.0:
        if is_rectified:
            return rectified_pair(left_camera, baseline_m, size_px)
        R_left, R_right = (_rotation(info) for info in (left, right))
        T_left_right = transform(R_left.T @ R_right, R_left.T @ np.array([baseline_m, 0.0, 0.0]))
    elif of_tf is None or not of_tf[:3, 3].any():
        raise SourceError(
            f"{where}: how far {topics.right.topic.name} is from {name} is unknown: P[3] of "
            f"{topics.right_info.topic.name} is 0, and tf does not say it; record /tf_static too"
        )
    elif is_rectified:
        return rectified_pair(left_camera, float(of_tf[0, 3]), size_px)
    else:
        T_left_right = of_tf
    return rectify(left_camera, right_camera, T_left_right, size_px)


def _info(reader: RecordingReader, series: Series | None) -> CameraMessage | None:
    """Return the calibration of a topic; None without one, and where it is all zeros."""
    info = series and reader.firsts.get(series.topic.name)
    if isinstance(info, CameraMessage) and (info.K.any() or info.P.any()):
        return info
    return None


def _rotation(info: CameraMessage) -> Array:
    """Return the rotation to the rectified camera's axes; none where the calibration leaves it out."""
    return nearest_rotation(info.R.reshape(3, 3)) if info.R.size == 9 and info.R.any() else np.eye(3)
