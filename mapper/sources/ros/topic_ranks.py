"""Ranks of topics by their names, the lowest first, for a choice between several of one kind."""

import re
from itertools import takewhile

from mapper.sources.ros.messages import GPS_FIXES, SENTENCES
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


def fix_rank(topic: Topic) -> tuple[int, ...]:
    """Rank fixes before sentences, and a receiver's before those that a filter made of several sensors."""
    is_filtered = any(word in topic.name.lower() for word in ("filter", "fused", "odom"))
    return is_filtered, topic.type in SENTENCES, topic.type in GPS_FIXES, topic.name.count("/")


def _is_packed(name: str) -> bool:
    return name.endswith(TRANSPORTS)
