"""Topics of a recording that are not used, with the reason, as notes and refusals name them."""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress

import numpy as np

from mapper.core.errors import FrameError, listed
from mapper.core.units import MM_PER_M, unit_of_gravity
from mapper.sources.depth_outlines import may_be_depth
from mapper.sources.ros.image_messages import depth_m_of, encoding_of, has_float_depth, is_depth, is_mono16
from mapper.sources.ros.message_index import Series
from mapper.sources.ros.messages import CLOUDS, FIXES, IMAGES, IMUS, POSES, READ, ImageMessage, Message
from mapper.sources.ros.topic_ranks import is_infrared

_BOOKKEEPING = re.compile(
    r"(?:action|bond|builtin_interfaces|control|diagnostic|dynamic_reconfigure|lifecycle|map|nav|rcl_interfaces"
    r"|realsense2_camera|rosbag2_interfaces|rosgraph|statistics|std|tf2|visualization)(?:_msgs)?/|actionlib"
    r"|foxglove\.Log|sensor_msgs/msg/Joy"
)
"""Beginnings of types of messages about programs, plans and pictures, which no sensor measured."""
_PACKED = re.compile("video|ffmpeg|theora|compressed", re.IGNORECASE)
"""Words in types of videos and of packed clouds."""
_OTHER_NUMBERS = re.compile("disparity|confidence", re.IGNORECASE)
"""Words in topics of images of numbers that are no depth."""
_PACKETS = re.compile(
    r"(?:UdpFrame|(?:Udp|Pandar|Rslidar|Robosense)(?:Scan|Packet)|NebulaPackets?)$", re.IGNORECASE
)
"""Ends of types of a LiDAR's packets of which nothing makes points here: Hesai's, RoboSense's, Nebula's."""


def unused_notes(
    unused: Iterable[Series], firsts: Mapping[str, Message], *, image_reason: str | None
) -> list[str]:
    """Return which sensors' topics are not used and why, a sentence for each kind.

    Args:
        unused: The topics.
        firsts: The first message of those that can be read.
        image_reason: Reason why images and clouds are not used; None where the user chose others.
    """
    kinds: dict[str, list[str]] = {}
    for one in unused:
        name, type_ = one.topic.name, one.topic.type
        if type_ in IMAGES and name in firsts:
            kind = image_reason and f"images that are not used, as {image_reason}"
        elif type_ in CLOUDS and name in firsts:
            reason = "there is a single one" if len(one) == 1 else "those of one topic are mapped"
            kind = image_reason and f"point clouds that are not used, as {reason}"
        elif type_ in IMUS and not feels_gravity(one):
            name = f"{name} ({usual_acceleration(one):.3g})"
            kind = (
                "accelerations that are not used, as their length is not gravity's, 9.81 m/s², 1 g, 1000 mg"
            )
        elif type_ in IMUS:
            kind = "accelerations that are not used, as one topic is enough (source.topics.imu)"
        elif type_ in FIXES:
            kind = "GNSS fixes that are not used, as one topic is enough (source.topics.gnss)"
        elif type_ in POSES:
            kind = "poses that are not used; source.topics.wheels reads those of wheels, .truth true ones"
        elif type_ in READ or _BOOKKEEPING.match(type_):
            kind = None
        else:
            name, kind = f"{name} ({type_})", "topics of types that are not read"
            if _PACKETS.search(type_):
                kind = "packets that are not read (play them through the LiDAR's driver, record PointCloud2)"
            elif _PACKED.search(type_):
                kind = "packed topics that are not read (record raw images, JPEG or PNG; PointCloud2)"
        if kind is not None:
            kinds.setdefault(kind, []).append(name)
    return [f"{kind}: {listed(names)}" for kind, names in kinds.items()]


def depth_topics(firsts: Mapping[str, Message]) -> tuple[set[str], set[str]]:
    """Return the topics of depth images, and those of grey ones of 16 bits.

    They are told apart by the outlines in the first image of topics that are called infrared or mono16, and
    of all where there are no other images, but for those that are called depth.
    """
    images = {
        name: first
        for name, first in firsts.items()
        if isinstance(first, ImageMessage) and not holds_other_numbers(name)
    }
    depths = {name for name, first in images.items() if is_depth(first)}
    is_alone = len(depths) == len(images) > 1
    greys = {
        name
        for name in depths
        if (is_alone or is_infrared(name) or is_mono16(images[name]))
        and "depth" not in name.lower()
        and not _may_be_depth(images[name], name)
    }
    return depths - greys, greys


def _may_be_depth(first: ImageMessage, name: str) -> bool:
    with suppress(FrameError):  # it is told when it is read
        return has_float_depth(first) or may_be_depth(depth_m_of(first, units_per_m=MM_PER_M, where=name))
    return True


def holds_other_numbers(name: str) -> bool:
    """Return whether a topic's name says that its images are neither depth nor colour."""
    return _OTHER_NUMBERS.search(name) is not None


def why_no_depths(firsts: Mapping[str, Message], depths: set[str], greys: set[str]) -> Iterator[str]:
    """Yield why images that are called depth or disparity are none, and how to tell depth from grey."""
    if len(both := sorted(depths | greys)) > 1 or greys:
        yield f"of 16 bits are {listed(both)}: source.topics.color=… and .depth=… say which is which"
    for name, first in firsts.items():
        if not isinstance(first, ImageMessage) or name in depths:
            continue
        if is_depth(first) and holds_other_numbers(name):
            yield f"{name} is called no depth; of disparity that is focal length · baseline / disparity"
        elif "depth" in name.lower():
            yield f"{name} is {encoding_of(first)!r}, not depth of 16 bits or 32-bit numbers (16UC1, 32FC1)"


def feels_gravity(series: Series) -> bool:
    """Return whether an accelerometer feels gravity: a gyroscope's empty accelerations do not."""
    return unit_of_gravity(usual_acceleration(series)) is not None


def turns(series: Series) -> bool:
    """Return whether a topic has angular velocities: an accelerometer's are empty."""
    return bool((np.nan_to_num(series.imu[:, :3]) != 0.0).any())


def usual_acceleration(series: Series) -> float:
    """Return the median length of an accelerometer's readings."""
    return float(np.median(np.linalg.norm(np.nan_to_num(series.imu[:, 3:]), axis=1)))


def what_there_is(color: Series | None, depth: Series | None, series: Iterable[Series]) -> str:
    """Return what a recording has instead of something that can be mapped.

    Args:
        color: Its likeliest colour images, if there are any.
        depth: Its likeliest depth images, if there are any.
        series: Every topic.
    """
    for kind, other, likeliest in (("colour", "depth", color), ("depth", "colour", depth)):
        if likeliest is not None:
            others = [one for one in series if one.topic.type in IMAGES and one is not likeliest]
            names = listed([one.topic.name for one in (likeliest, *others)])
            return f"{kind} images {names}, but neither {other} images nor point clouds"
    names = ", ".join(
        f"{one.topic.name} ({one.topic.type}{', a single one' if len(one) == 1 else ''})" for one in series
    )
    return (
        f"neither images with depth nor several point clouds, only {names}"
        if names
        else "no message of it can be read"
    )
