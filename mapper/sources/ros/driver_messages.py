"""Messages of LiDAR drivers' own types as point clouds: Livox' CustomMsg, Velodyne's packets.

They are unpacked here, as a general decoder makes an object of each of a message's 20 000 points. ROS 1 packs
the elements of an array; CDR aligns them.
"""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mapper.core.timebase import NS_PER_S
from mapper.sources.ros.cloud_messages import without_noise
from mapper.sources.ros.messages import LIVOX, CloudMessage
from mapper.sources.ros.recording import Topic
from mapper.sources.velodyne_packets import PACKET_BYTES, decode_packets

_HEADER_BYTES = 16
"""Four of the encapsulation (CDR) or of a counter (ROS 1), then seconds, nanoseconds, the frame's length."""
_COUNT = ("count", "u4")
_LIVOX_HEAD = [("timebase", "u8"), ("point_num", "u4"), ("lidar_id", "u1"), ("rsvd", "u1", 3), _COUNT]
_LIVOX_POINT = [
    *[("offset_time", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4")],
    *[("reflectivity", "u1"), ("tag", "u1"), ("line", "u1")],
]
_VELODYNE_PACKET = [("sec", "u4"), ("nanosec", "u4"), ("data", "u1", PACKET_BYTES)]


def decode_driver_message(topic: Topic, data: memoryview) -> CloudMessage:
    """Return the points of a CustomMsg of livox_ros_driver or of a VelodyneScan, with times after the stamp.

    Raises:
        DataError: Its packets are damaged, or of a Velodyne that is not known.
        ValueError: It has fewer bytes than its number of points or packets needs.
        DependencyError: The library that decodes packets is not installed.
    """
    if topic.type in LIVOX:
        stamp_ns, frame, points = _unpack(topic, data, _LIVOX_HEAD, _LIVOX_POINT)
        points, notes = without_noise(points)
        return CloudMessage(stamp_ns, frame, points, notes=notes)
    stamp_ns, frame, packets = _unpack(topic, data, [_COUNT], _VELODYNE_PACKET)
    received_ns = packets["sec"].astype(np.int64) * NS_PER_S + packets["nanosec"]
    payloads = [packet.tobytes() for packet in packets["data"]]
    return CloudMessage(stamp_ns, frame, decode_packets(payloads, received_ns, stamp_ns))


def _unpack(
    topic: Topic, data: memoryview, head: list[Any], element: list[Any]
) -> tuple[int, str, NDArray[np.void]]:
    """Return the stamp, the frame and the (N,) elements of the array that ends a message."""
    is_cdr = topic.encoding != "ros1"
    order: Literal["<", ">"] = ">" if is_cdr and not data[1] & 1 else "<"
    sec, nanosec, frame_bytes = np.frombuffer(data, f"{order}u4", count=3, offset=4).tolist()
    start = _HEADER_BYTES + frame_bytes
    frame = bytes(data[_HEADER_BYTES:start]).rstrip(b"\0").decode(errors="replace")
    head_type = np.dtype(head).newbyteorder(order)
    if is_cdr:
        start += -(start - 4) % head_type[0].itemsize  # counted from the end of the encapsulation
    count = int(np.frombuffer(data, head_type, count=1, offset=start)["count"][0])
    elements = bytes(data[start + head_type.itemsize :]) + b"\0\0\0"  # the last one is not padded
    element_type = np.dtype(element, align=is_cdr).newbyteorder(order)
    return sec * NS_PER_S + nanosec, frame, np.frombuffer(elements, element_type, count=count)
