"""Which calibration of a recording is that of which images, by namespaces and coordinate frames."""

from collections.abc import Mapping, Sequence

from mapper.sources.ros.message_index import Series
from mapper.sources.ros.messages import Message, frame_of
from mapper.sources.ros.topic_ranks import TRANSPORTS, is_called_registered, shared_namespaces


def infos_beside(image: Series, infos: Sequence[Series]) -> list[Series]:
    """Return the calibrations in an image topic's own namespace, or in the one that it shares most with.

    realsense-viewer has /device_0/sensor_1/Color_0/info/camera_info beside …/Color_0/image/data.
    """
    name = image.topic.name
    for transport in TRANSPORTS:
        name = name.removesuffix(transport)
    own = [one for one in infos if one.topic.name.rpartition("/")[0] == name.rpartition("/")[0]]
    if own:
        return own
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
