"""Sensors of a recording beside the one that is tracked, and where tf says that they are on its body."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform
from mapper.core.timebase import Stamps
from mapper.sources.base import Log, SensorBeside
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import shifted
from mapper.sources.ros.message_index import Series
from mapper.sources.ros.reader import RecordingReader
from mapper.sources.ros.recorded_frames import log_of_frames
from mapper.sources.ros.topics import CameraTopics


def sensors_beside(
    reader: RecordingReader,
    topics: Sequence[Series | CameraTopics],
    tracked: Log,
    config: SourceConfig,
) -> tuple[list[SensorBeside], list[str]]:
    """Return the sensors that can be fused, and a sentence on what is done with each.

    Args:
        reader: The recording.
        topics: Those of each sensor.
        tracked: Frames of the sensor that is tracked.
        config: How the log is read; ``body_frame`` is the tracked sensor's.
    """
    config = config.model_copy(update={"body_frame": None})
    found: list[SensorBeside] = []
    sentences = []
    for one in topics:
        name = one.depth.topic.name if isinstance(one, CameraTopics) else one.topic.name
        try:
            log = log_of_frames(reader, one, config)
            T_body_sensor = _mounting(reader, tracked.body_frame, log)
        except SourceError as error:
            sentences.append(f"{name}: not fused: {error}")
            continue
        taken_ns = [tracked.stamps_ns, *(sensor.log.stamps_ns for sensor in found)]
        distinct = _with_own_stamps(replace(log, name=name), np.concatenate(taken_ns))
        found.append(SensorBeside(distinct, T_body_sensor))
        is_tracked = config.topics.others == "tracked" and tracked.sensor == log.sensor == "lidar"
        how = "tracked with the others, and fused" if is_tracked else "fused too, at the poses of the path"
        sentences.append(f"{name}: {how}; source.topics.others=unused leaves it out")
        sentences += log.notes
    return found, sentences


def _mounting(reader: RecordingReader, body: str, log: Log) -> Transform:
    """Return T_body_sensor by tf.

    Raises:
        SourceError: tf does not state it, or it moves, or a LiDAR's frame is the robot's base.
    """
    sensor = log.body_frame
    T_body_sensor = reader.tree.find(body, sensor)
    if T_body_sensor is None:
        raise SourceError(f"tf does not say where {sensor} is on {body}")
    if reader.tree.moves(body, sensor):
        raise SourceError(f"{sensor} moves on {body}")
    if log.sensor == "lidar" and sensor == reader.base_of(sensor):
        raise SourceError(f"{sensor} is the robot's base, where copies of other sensors' clouds are")
    return T_body_sensor


def _with_own_stamps(log: Log, taken_ns: Stamps) -> Log:
    """Return a log whose stamps are raised by as few nanoseconds as make them differ from others."""
    shift_ns = 0
    while np.isin(log.stamps_ns + shift_ns, taken_ns).any():
        shift_ns += 1
    return shifted(log, shift_ns)
