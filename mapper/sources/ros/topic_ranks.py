"""Which topics go first, the lowest rank, and which belong together, by names and coordinate frames."""

import re
from collections.abc import Mapping, Sequence
from itertools import takewhile

from mapper.sources.ros.message_index import Series
from mapper.sources.ros.messages import GPS_FIXES, SENTENCES, Message, frame_of
from mapper.sources.ros.recording import Topic

TRANSPORTS = ("/compressedDepth", "/compressed")
"""What image_transport appends to an image's own topic."""


def shared_namespaces(name: str, other: str) -> int:
    """Return how many namespaces two topics begin with in common."""
    parts = zip(name.strip("/").split("/")[:-1], other.strip("/").split("/")[:-1], strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], parts))


def color_rank(name: str) -> tuple[int, ...]:
    """Rank images of light before infrared ones, colour before grey, and raw before packed ones."""
    lower = name.lower()
    return int(is_infrared(name)), int("color" not in lower and "rgb" not in lower), int(_is_packed(name))


def depth_rank(name: str) -> tuple[int, ...]:
    """Rank depth that is called registered first, and raw before packed."""
    return int(is_infrared(name)), int(not is_called_registered(name)), int(_is_packed(name))


def is_infrared(name: str) -> bool:
    """Return whether the name of a topic of images says that they are infrared or a fisheye's."""
    return re.search(r"infra|fisheye|[/_]ir(?![a-z])", name.lower()) is not None


def is_called_rectified(name: str) -> bool:
    """Return whether the name of a topic says that its images are rectified: image_rect, not unrectified."""
    return re.search("(?<![a-z])rect", name) is not None


def is_called_registered(name: str) -> bool:
    """Return whether the name of a depth topic says that it is registered to colour."""
    return any(word in name.lower() for word in ("aligned", "registered", "to_rgb", "to_color"))


def cloud_rank(name: str) -> tuple[int, ...]:
    """Rank clouds of a driver before clouds that were computed from them, and before its packets."""
    lower = name.lower()
    is_made = any(word in lower for word in ("map", "filter", "ground", "cluster", "registered", "depth"))
    is_driven = any(word in lower for word in ("lidar", "velodyne", "ouster", "points"))
    return int(is_made), int(not is_driven), int("packets" in lower)


def plain_rank(name: str) -> tuple[int, ...]:
    """Rank topics of few namespaces first, and packets last."""
    return int("packets" in name), name.count("/")


def imu_rank(name: str, tracked: Series | None, is_of_camera: bool) -> tuple[int, ...]:
    """Rank those in the tracked topic's namespaces first, and beside a LiDAR those of cameras last."""
    is_of_another = not is_of_camera and re.search("camera|realsense|zed|oak", name.lower()) is not None
    shared = 0 if tracked is None else shared_namespaces(name, tracked.topic.name)
    return -shared, int(is_of_another), *plain_rank(name)


def fix_rank(topic: Topic) -> tuple[int, ...]:
    """Rank fixes before sentences, and a receiver's before those that a filter made of several sensors."""
    is_filtered = any(word in topic.name.lower() for word in ("filter", "fused", "odom"))
    return is_filtered, topic.type in SENTENCES, topic.type in GPS_FIXES, topic.name.count("/")


def infos_beside(image: Series, infos: Sequence[Series]) -> list[Series]:
    """Return the calibrations in an image topic's own namespace, or in the one that it shares most with.

    Of several in its own those come first that share more words with it: camera_info_l with image_l.
    realsense-viewer has /device_0/sensor_1/Color_0/info/camera_info beside …/Color_0/image/data.
    """
    name = image.topic.name
    for transport in TRANSPORTS:
        name = name.removesuffix(transport)
    namespace, _, last = name.rpartition("/")
    own = [one for one in infos if one.topic.name.rpartition("/")[0] == namespace]
    if own:
        words = set(last.split("_"))
        return sorted(own, key=lambda one: -len(words & set(one.topic.name.rpartition("/")[2].split("_"))))
    shared = [shared_namespaces(name, one.topic.name) for one in infos]
    most = max(shared, default=0)
    return [infos[shared.index(most)]] if most and shared.count(most) == 1 else []


def info_of(image: Series, infos: Sequence[Series], firsts: Mapping[str, Message]) -> Series | None:
    """Return the calibration of an image topic, by its namespace or frame, or as there is no other."""
    only = infos if len(infos) == 1 else []
    return next(iter([*infos_beside(image, infos), *_of_frame(image, infos, firsts), *only]), None)


def without_those_of_depth(infos: Sequence[Series], color: Series, depth: Series) -> list[Series]:
    """Return the calibrations that are not the depth camera's own, by the namespaces that they share."""
    if is_called_registered(depth.topic.name):
        return list(infos)

    def nearness(one: Series, image: Series) -> int:
        return shared_namespaces(image.topic.name, one.topic.name)

    return [one for one in infos if nearness(one, color) >= nearness(one, depth)]


def _of_frame(image: Series, infos: Sequence[Series], firsts: Mapping[str, Message]) -> list[Series]:
    """Return the calibration of an image's coordinate frame; none where several cameras name the same."""
    frame = frame_of(firsts.get(image.topic.name))
    found = [one for one in infos if frame and frame_of(firsts.get(one.topic.name)) == frame]
    return found if len(found) == 1 else []


def _is_packed(name: str) -> bool:
    return name.endswith(TRANSPORTS)
