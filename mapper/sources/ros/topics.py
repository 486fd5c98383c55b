"""Choice of the topics that a map is made from: the user's, or a guess that a note reports."""

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from mapper.core.errors import SourceError
from mapper.sources.config import TopicsConfig
from mapper.sources.ros.frame_tree import BY_TF, ESTIMATED, is_fixed
from mapper.sources.ros.message_index import Series
from mapper.sources.ros.messages import (
    CAMERAS,
    CLOUDS,
    FIXES,
    IMAGES,
    IMUS,
    LASERS,
    ODOMETRY,
    POSES,
    READ,
    Message,
    frame_of,
)
from mapper.sources.ros.topic_ranks import (
    cloud_rank,
    color_rank,
    depth_rank,
    fix_rank,
    imu_rank,
    info_of,
    infos_beside,
    is_called_rectified,
    plain_rank,
    shared_namespaces,
    without_those_of_depth,
)
from mapper.sources.ros.unused_topics import (
    depth_topics,
    feels_gravity,
    holds_other_numbers,
    turns,
    unused_notes,
    usual_acceleration,
    what_there_is,
    why_no_depths,
)

TRUTH, WHEELS = "/ground_truth", "/wheel_odometry"

_OWN_TYPES = "mapper/msg/"
_SIDES = re.compile(
    r"left|infra1|Infrared_1|cam0|camera0|port(?![a-z])|(?<![a-z0-9])l(?![a-z0-9])", re.IGNORECASE
)
_SIDE_WORDS = ("left:right", "infra1:infra2", "infrared_1:Infrared_2", "cam0:cam1", "camera0:camera1")
_OTHER_SIDE = dict(pair.split(":") for pair in (*_SIDE_WORDS, "port:starboard", "l:r"))
"""Words in topics of left images, and in those of the right ones beside them."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraTopics:
    """Topics of an RGB-D camera.

    Attributes:
        color: Colour or grey images.
        depth: Depth images.
        info: The colour camera's calibration, if there is any: the user's choice, else ``own_info``.
        own_info: The calibration that the recording has beside the colour images, if there is any.
        depth_info: The depth camera's own, if there is any.
    """

    color: Series
    depth: Series
    info: Series | None
    own_info: Series | None
    depth_info: Series | None


@dataclass(frozen=True, slots=True, eq=False)
class StereoTopics:
    """Topics of a stereo pair.

    Attributes:
        left: Images of the left camera.
        right: Images of the right camera.
        left_info: Its calibration, if there is any.
        right_info: That of the right camera.
    """

    left: Series
    right: Series
    left_info: Series | None
    right_info: Series | None


@dataclass(frozen=True, slots=True, eq=False)
class ImageTopics:
    """Topics of a camera beside a LiDAR.

    Attributes:
        images: Colour or grey images.
        info: Their calibration.
    """

    images: Series
    info: Series


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """Topics that are read.

    Attributes:
        frames: Topics that are mapped: images with depth, stereo pairs, or clouds.
        imu: Inertial readings, if there are any.
        gyroscope: Readings with angular velocities: the same topic, if it has them.
        gnss: Fixes of a GNSS receiver, if there are any.
        truth: True poses, if there are any.
        wheels: Wheel odometry, if it was requested or is called so.
        cameras: Cameras beside the clouds, one of each coordinate frame, which colour them.
        beside: Topics of other sensors that are fused.
        choices: What is used, a sentence each.
        notes: What is not, or may be wrong, a sentence each.
    """

    frames: CameraTopics | StereoTopics | Series
    imu: Series | None
    gyroscope: Series | None
    gnss: Series | None
    truth: Series | None
    wheels: Series | None
    cameras: Sequence[ImageTopics]
    beside: Sequence[Series | CameraTopics]
    choices: Sequence[str]
    notes: Sequence[str]


def choose(
    series: Mapping[str, Series],
    firsts: Mapping[str, Message],
    config: TopicsConfig,
    *,
    frames_of_tf: Collection[str],
    path: Path,
) -> Choice:
    """Return the topics to read: images where colour has depth, else clouds, else stereo pairs.

    Args:
        series: Every topic.
        firsts: The first message of those that can be read.
        config: The user's choice of topics.
        frames_of_tf: Coordinate frames: of several IMUs one whose mounting they may state goes first.
        path: Recording, for errors.

    Raises:
        SourceError: A chosen topic is not there or of another type, or nothing can be mapped.
    """
    pick = _Picker(series, path)
    depths, greys = depth_topics(firsts)
    colors = pick.candidates(
        "color",
        config.color,
        IMAGES,
        where=lambda name: not (name in depths or holds_other_numbers(name)),
    )
    colors = [one for one in colors if one.topic.name not in greys] or colors
    depth_images = pick.candidates("depth", config.depth, IMAGES, where=depths.__contains__)
    color, depth = _of_one_camera(colors, depth_images, firsts)
    clouds = pick.candidates("points", config.points, CLOUDS, where=lambda name: len(series[name]) > 1)
    points = _best([one for one in clouds if one.topic.type not in LASERS] or clouds, cloud_rank)
    imus = pick.candidates("imu", config.imu, IMUS, where=lambda name: feels_gravity(series[name]))

    def is_in_tf(name: str) -> bool:
        return frame_of(firsts.get(name)) in frames_of_tf

    tracked = points if color is None or depth is None or config.points is not None else color
    imu = _best(imus, lambda name: (not is_in_tf(name), *imu_rank(name, tracked, tracked is color)))
    gyroscope = imu if imu is not None and turns(imu) and config.gyroscope is None else None
    if gyroscope is None:
        gyroscope = pick.one(
            "gyroscope", config.gyroscope, IMUS, plain_rank, where=lambda name: turns(series[name])
        )
    gnss = pick.one(
        "gnss", config.gnss, FIXES, lambda name: fix_rank(series[name].topic), where=lambda _name: True
    )
    named = None if (config.truth or "").startswith(BY_TF) else config.truth
    truth = pick.one("truth", named, POSES, plain_rank, where=lambda name: name == TRUTH)
    wheels = pick.one("wheels", config.wheels, POSES, plain_rank, where=lambda name: name == WHEELS)
    if wheels is None and points is not None and points.topic.type in LASERS:
        driven = [
            one for one in pick.all(ODOMETRY) if one is not truth and not ESTIMATED.search(one.topic.name)
        ]
        wheels = _best(driven, plain_rank)
    pick.refuse_own_runs()
    notes: list[str] = []
    if imu is not None and gyroscope is None:
        notes.append(f"{imu.topic.name}: its angular velocities are all 0 or no numbers; not used")
    frames: CameraTopics | StereoTopics | Series
    cameras: list[ImageTopics] = []
    beside: list[Series | CameraTopics] = []
    info = pick.one("camera_info", config.camera_info, CAMERAS, plain_rank, where=set().__contains__)
    camera = (
        None if color is None or depth is None else _camera(color, depth, info, pick.all(CAMERAS), firsts)
    )
    if camera is not None and config.points is None:
        frames, own = camera, camera.own_info
        others = len(colors) * len(depth_images) > 1 or bool(greys)
        chosen = f"colour {camera.color.topic.name}, depth {camera.depth.topic.name}"
        choices = [_choice_note(chosen, "color=… and source.topics.depth", others=others)]
        if info is not None and own not in (None, info):
            notes.append(f"camera info {info.topic.name} was chosen; that of the images is {own.topic.name}")
        used, image_reason = [color, depth, points], "one camera is mapped"
        beside += _clouds_beside(pick.all(CLOUDS), firsts, tracked=[camera.color, camera.depth])
        if points is not None:
            what = "there are" if points in beside and config.others != "unused" else "not used are the"
            choices.append(
                f"{what} point clouds {points.topic.name}: to track those, "
                f"source.topics.points={points.topic.name}"
            )
    elif points is not None:
        frames = points
        kind = "laser scans" if points.topic.type in LASERS else "point clouds"
        choices = [_choice_note(f"{kind} {points.topic.name}", "points", others=len(clouds) > 1)]
        image_reason = "point clouds are mapped" if camera else "they have neither depth nor camera info"
        beside += _clouds_beside(pick.all(CLOUDS), firsts, tracked=[points])
        beside += [camera] if camera else []
        if points.topic.type not in LASERS:
            cameras = _cameras(colors, pick.all(CAMERAS), firsts)
        used = [points, *(camera.images for camera in cameras)]
    elif pairs := _stereo_pairs(colors, pick.all(IMAGES)):
        left, right = pairs[0]
        infos = pick.all(CAMERAS)
        left_info, right_info = (next(iter(infos_beside(one, infos)), None) for one in (left, right))
        frames = StereoTopics(left, right, left_info, right_info)
        chosen = f"stereo pairs {left.topic.name} and {right.topic.name}"
        choices = [_choice_note(chosen, "color", others=len(pairs) > 2)]
        used, image_reason = [left, right], "one pair is mapped"
    else:
        strange = [one for one in series.values() if one.topic.type not in READ]
        unread = [
            *unused_notes(strange, firsts, image_reason=None),
            *why_no_depths(firsts, depths, greys),
        ]
        found = what_there_is(color, depth, series.values())
        raise SourceError("; ".join([f"{path}: nothing to map: {found}", *unread]))
    if imu is not None and len(imus) > 1:
        why = (
            "whose frame is in tf" if is_in_tf(imu.topic.name) else "by its name, as tf has the frame of none"
        )
        choices.append(_choice_note(f"accelerations {imu.topic.name}, {why}", "imu", others=True))
    if wheels is not None:
        choices.append(
            _choice_note(f"wheel odometry {wheels.topic.name}", "wheels", others=config.wheels is None)
        )
    if config.others == "unused":
        beside = []
    for one in beside:
        used += [one.color, one.depth] if isinstance(one, CameraTopics) else [one]
    is_chosen = bool(config.points or config.color or config.depth)
    used = [*used, imu, gnss, truth, wheels]
    if gyroscope is not None and (feels_gravity(gyroscope) or not usual_acceleration(gyroscope) > 0.0):
        used.append(gyroscope)
    unused = [one for one in series.values() if one not in used]
    notes += unused_notes(unused, firsts, image_reason=None if is_chosen else image_reason)
    return Choice(frames, imu, gyroscope, gnss, truth, wheels, cameras, beside, choices, notes)


class _Picker:
    """Finds topics by what the user set, or else by rank."""

    def __init__(self, series: Mapping[str, Series], path: Path) -> None:
        self._series = series
        self._path = path

    def all(self, types: Collection[str]) -> list[Series]:
        """Return every topic of some types."""
        return [one for one in self._series.values() if one.topic.type in types]

    def one(
        self,
        role: str,
        wanted: str | None,
        types: Collection[str],
        rank: Callable[[str], tuple[int, ...]],
        *,
        where: Callable[[str], bool],
    ) -> Series | None:
        """Return the topic that is wanted, else the one of the lowest rank, else None."""
        return _best(self.candidates(role, wanted, types, where=where), rank)

    def candidates(
        self, role: str, wanted: str | None, types: Collection[str], *, where: Callable[[str], bool]
    ) -> list[Series]:
        """Return the topic that is wanted, else all that may be meant."""
        there = self.all(types)
        if wanted is None:
            return [one for one in there if where(one.topic.name)]
        names = [one.topic.name for one in there]
        if wanted not in names:
            what = f"of type {self._series[wanted].topic.type}" if wanted in self._series else "not there"
            raise SourceError(
                f"{self._path}: source.topics.{role}={wanted} is {what}; "
                f"topics for that: {', '.join(names) or 'none'}"
            )
        return [self._series[wanted]]

    def refuse_own_runs(self) -> None:
        """Refuse the log of a run, whose clouds and images are results."""
        if any(one.topic.type.startswith(_OWN_TYPES) for one in self._series.values()):
            raise SourceError(
                f"{self._path}: a run that mapper wrote: its trajectory, its map and images without depth; "
                "build from the log that it was made from, or look at the run: mapper view"
            )


def _of_one_camera(
    colors: Sequence[Series], depths: Sequence[Series], firsts: Mapping[str, Message]
) -> tuple[Series | None, Series | None]:
    """Return the colour and depth topic that fit best, of one coordinate frame or namespace where any are.

    Depth of one camera is not registered to the colour of another, however alike their images are.
    """

    def rank(pair: tuple[Series, Series]) -> tuple[object, ...]:
        color, depth = (one.topic.name for one in pair)
        frames = [frame_of(firsts.get(name)) for name in (color, depth)]
        apart, shared = frames[0] != frames[1] or not frames[0], shared_namespaces(color, depth)
        fewest = min(map(len, pair))
        other = apart and not shared
        return other, color_rank(color), depth_rank(depth), apart, -shared, -fewest, color, depth

    if colors and depths:
        return min(product(colors, depths), key=rank)
    return _best(colors, color_rank), min(depths, key=lambda one: one.topic.name, default=None)


def _camera(
    color: Series,
    depth: Series,
    info: Series | None,
    infos: Sequence[Series],
    firsts: Mapping[str, Message],
) -> CameraTopics:
    """Return the topics of an RGB-D camera; ``info`` is the calibration that the user chose."""
    own = info_of(color, without_those_of_depth(infos, color, depth), firsts)
    depth_info = next((one for one in infos_beside(depth, infos) if one is not own), None)
    return CameraTopics(color, depth, info or own, own, depth_info)


def _clouds_beside(
    clouds: Sequence[Series], firsts: Mapping[str, Message], *, tracked: Sequence[Series]
) -> list[Series]:
    """Return the clouds of LiDARs in other coordinate frames, of each the topic that ranks first.

    Args:
        clouds: All topics of clouds and laser scans; those that were computed from others are left out.
        firsts: First messages.
        tracked: Topics of the sensor that is tracked.
    """
    found = list(tracked)
    for one in sorted(clouds, key=lambda one: (cloud_rank(one.topic.name), one.topic.name)):
        frame, (is_made, _, is_packed) = frame_of(firsts.get(one.topic.name)), cloud_rank(one.topic.name)
        # A driver may publish packets in another frame than the clouds that it makes of them.
        is_known = frame in [frame_of(firsts.get(other.topic.name)) for other in found] or (
            is_packed and _namespace(one) in map(_namespace, found)
        )
        if len(one) > 1 and frame and not (is_known or is_made or is_fixed(frame)):
            found.append(one)
    return found[len(tracked) :]


def _namespace(one: Series) -> str:
    return one.topic.name.rpartition("/")[0]


def _stereo_pairs(lefts: Sequence[Series], images: Sequence[Series]) -> list[tuple[Series, Series]]:
    """Return the topics of pairs by their names, in both orders: rectified ones first, then left ones."""
    by_name = {one.topic.name: one for one in images}
    found = [
        (left, by_name[other])
        for left in images
        if (other := next((one for one in _other_sides(left.topic.name) if one in by_name), None)) is not None
    ]
    found = [pair for left, right in found for pair in ((left, right), (right, left)) if pair[0] in lefts]
    return sorted(found, key=lambda pair: (not is_called_rectified(pair[0].topic.name), pair[0].topic.name))


def _other_sides(name: str) -> Iterator[str]:
    """Yield a name with the other side's word for the last of its own, for one before it, and for all."""
    sides = list(_SIDES.finditer(name))
    for side in reversed(sides):
        yield name[: side.start()] + _OTHER_SIDE[side[0].lower()] + name[side.end() :]
    if len(sides) > 1:
        yield _SIDES.sub(lambda side: _OTHER_SIDE[side[0].lower()], name)


def _best(topics: Sequence[Series], rank: Callable[[str], tuple[int, ...]]) -> Series | None:
    """Return the topic of the lowest rank, of equal ones that of the most messages; None of none."""
    return min(topics, key=lambda one: (*rank(one.topic.name), -len(one), one.topic.name), default=None)


def _choice_note(choice: str, option: str, *, others: bool) -> str:
    return f"{choice}; choose others with source.topics.{option}=…" if others else choice


def _cameras(
    colors: Sequence[Series], infos: Sequence[Series], firsts: Mapping[str, Message]
) -> list[ImageTopics]:
    """Return the calibrated cameras of some images, of each coordinate frame the one that ranks first."""
    found: dict[str, ImageTopics] = {}
    for one in sorted(colors, key=lambda one: (color_rank(one.topic.name), one.topic.name)):
        frame, info = frame_of(firsts.get(one.topic.name)), info_of(one, infos, firsts)
        if frame and info is not None:
            found.setdefault(frame, ImageTopics(one, info))
    return list(found.values())
