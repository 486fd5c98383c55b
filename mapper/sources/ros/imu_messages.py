"""Readings of sensor_msgs/Imu, unpacked without decoding: what follows the header has a fixed layout."""

import struct
from math import nan

from mapper.core.errors import DataError
from mapper.sources.ros.decode import decompressed
from mapper.sources.ros.recording import Topic

_UNPACK = {order: struct.Struct(f"{order}104x3d72x3d72x") for order in "<>"}
"""Orientation and its covariance, angular velocity, covariance, acceleration, covariance: 37 doubles."""
_HEADER_BYTES = 12
_NONE = (nan,) * 6


def readings_of(topic: Topic, data: memoryview) -> tuple[float, ...]:
    """Return the angular velocity and the acceleration, six numbers; NaN of a message that is damaged.

    The numbers end a message in both CDR and ROS 1, so the length of the frame's name does not matter.
    """
    try:
        data = decompressed(topic, data)
    except DataError:
        return _NONE
    order = "<" if topic.encoding == "ros1" or bytes(data[1:2]) == b"\1" else ">"
    offset = len(data) - _UNPACK[order].size
    if topic.encoding not in ("cdr", "ros1") or offset < _HEADER_BYTES:
        return _NONE
    return _UNPACK[order].unpack_from(data, offset)
