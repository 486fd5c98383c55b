"""Reader of a recording: an index from one pass over it, its poses, inertial readings and GNSS fixes."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError, SourceError
from mapper.core.frames import Sensor
from mapper.core.geometry import FARTHEST_M, spread_indices
from mapper.core.rotations import pose_of_row
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Positions, Trajectory
from mapper.sensing.gnss import GnssFixes
from mapper.sensing.gyroscope import Gyroscope
from mapper.sources.base import BASES, FOOTPRINT, Accelerations
from mapper.sources.config import WheelsConfig
from mapper.sources.imu_files import accelerations_of, gyroscope_of
from mapper.sources.nmea import fixes_from_sentences
from mapper.sources.ros.decode import decode
from mapper.sources.ros.entries import Located
from mapper.sources.ros.frame_tree import BY_TF, FrameTree, is_of_wheels
from mapper.sources.ros.message_index import Series, first_messages, index_of
from mapper.sources.ros.message_order import ordered
from mapper.sources.ros.messages import (
    SENTENCES,
    TRANSFORMS,
    FixMessage,
    Message,
    PoseMessage,
    SentenceMessage,
    frame_of,
)
from mapper.sources.ros.recording import Recording
from mapper.sources.ros.topic_ranks import shared_namespaces
from mapper.sources.text import ROUNDING, time_order, told_without_rotations
from mapper.sources.wheel_files import mounting

_MAX_TRANSFORMS = 1_000
SAME_CLOCK_NS = 60 * NS_PER_S
"""Messages are recorded within seconds of their stamps."""


class RecordingReader:
    """Recording and its index, from one pass over it.

    Attributes:
        recording: The file.
        series: When and where the messages of each topic are, by its name.
        firsts: The first whole message of each topic whose type is read.
        tree: The coordinate frames.
    """

    def __init__(self, recording: Recording) -> None:
        """Read the recording from end to end."""
        self.recording = recording
        self.series: Mapping[str, Series] = index_of(recording)
        self.firsts: Mapping[str, Message] = first_messages(recording, self.series.values())
        self._clock_ns = 0
        self.tree = FrameTree(self._transforms(most=_MAX_TRANSFORMS))

    @cached_property
    def whole_tree(self) -> FrameTree:
        """The coordinate frames with every pose of those that move."""
        return FrameTree(self._transforms(most=None))

    def follow_clock(self, frames: Series) -> None:
        """Move transforms without stamps, and those on another clock than some frames, to that of these."""
        self._clock_ns = frames.clock_ns

    def tree_of(self, to: str, from_: str) -> FrameTree:
        """Return a tree with every pose of the frames between two."""
        return self.whole_tree if self.tree.moves(to, from_) else self.tree

    def located(self, series: Series, i: int) -> Located:
        """Return message ``i`` of a topic, to be read later."""
        return Located(self.recording, series.topic, int(series.stamps_ns[i]), series.place(i))

    def spread_messages(self, series: Series, *, most: int) -> list[Message]:
        """Return a topic's first message, its last, and others between them; damaged ones are left out."""
        return [message for _, message in self._messages(series, spread_indices(len(series), most))]

    def truth(self, series: Series | None, *, body: str) -> tuple[Trajectory | None, list[str]]:
        """Return the poses of a topic as those of the body, and notes."""
        if series is None:
            return None, []
        truth, child, notes = self._poses_of(series)
        truth, notes = told_without_rotations(truth, notes, what=series.topic.name)
        if isinstance(truth, Positions):
            return truth, notes
        if truth is None or child in ("", body):
            return truth, notes
        if self.tree.find(child, body) is None:
            note = f"{series.topic.name}: poses of {child}, which tf does not tie to {body}; taken as its own"
            return truth, [*notes, note]
        return self._carried(truth, child, body), notes

    def truth_by_tf(self, frame: str, *, body: str) -> tuple[Trajectory, list[str]]:
        """Return the body's poses in a frame of tf in which it moves, and that they were chosen.

        Raises:
            SourceError: It does not move in that frame.
        """
        path = self.whole_tree.path_in(frame.lstrip("/"), body)
        if path is None or not len(path):
            frames = ", ".join(self.tree.moving_above(body)) or "none"
            raise SourceError(
                f"{self.recording.path}: source.topics.truth={BY_TF}{frame}: by tf {body} does not move in "
                f"{frame}; frames in which it does: {frames}"
            )
        return path, [f"true poses by tf: {frame} → {body}"]

    def wheels(
        self, series: Series | None, *, body: str, config: WheelsConfig, sensor: Sensor
    ) -> tuple[Trajectory | None, list[str]]:
        """Return T_odom_body of a topic of wheel odometry, and notes; tf ties the two unless the user does.

        Poses of the body's own frame are taken as they are.

        Raises:
            SourceError: What the user set is no pose.
        """
        if series is None:
            return None, []
        wheels, child, notes = self._poses_of(series)
        if wheels is None or child == body:
            return wheels, notes
        if child and config.body_in_base is None and self.tree.find(child, body) is not None:
            return self._carried(wheels, child, body), notes
        if config.body_in_base is None:
            notes.append(f"{series.topic.name}: {_untied(child, body)}")
        return replace(wheels, T_world_body=wheels.T_world_body @ mounting(config, sensor)), notes

    def wheels_by_tf(
        self, body: str, *, config: WheelsConfig, sensor: Sensor
    ) -> tuple[Trajectory | None, list[str]]:
        """Return T_odom_body by the transforms that a robot's base publishes (REP 105), and a note.

        Where tf does not tie the two the base is taken as for a topic.
        """
        odom = next((frame for frame in self.tree.frames if is_of_wheels(frame)), None)
        if odom is None:
            return None, []
        wheels = self.whole_tree.path_in(odom, body)
        if wheels is not None:
            return wheels, [f"wheel odometry by tf: {odom} → {body}"]
        base = self.tree.carried_by(odom)
        wheels = None if base is None else self.whole_tree.path_in(odom, base)
        if wheels is None:
            return None, []
        wheels = replace(wheels, T_world_body=wheels.T_world_body @ mounting(config, sensor))
        return wheels, [f"wheel odometry by tf: {odom} → {base}; {_untied(base, body)}"]

    def accelerations(self, series: Series | None, *, body: str) -> tuple[Accelerations | None, list[str]]:
        """Return the readings of a topic, in the body's axes where tf ties the two, and notes."""
        if series is None:
            return None, []
        order, notes = ordered(series)
        felt, more = accelerations_of(series.topic.name, series.stamps_ns[order], series.imu[order, 3:])
        notes = [*notes, *more]
        if felt is None:
            return None, notes
        imu = frame_of(self.firsts.get(series.topic.name))
        tree = self.tree_of(body, imu)
        known, T_body_imu = tree.find_each(body, imu, felt.stamps_ns)
        if not known.any():
            return felt, notes
        acceleration_body = np.einsum("nij,nj->ni", T_body_imu[:, :3, :3], felt.acceleration_mps2[known])
        place_body = None if tree.moves(body, imu) else T_body_imu[0, :3, 3]
        return Accelerations(felt.stamps_ns[known], acceleration_body, True, place_body), notes

    def gyroscope(self, series: Series | None, *, body: str) -> tuple[Gyroscope | None, list[str]]:
        """Return the angular velocities of a topic, with the mounting if tf has one that stays, and notes."""
        if series is None:
            return None, []
        order, notes = ordered(series)
        found, more = gyroscope_of(series.topic.name, series.stamps_ns[order], series.imu[order, :3])
        imu = frame_of(self.firsts.get(series.topic.name))
        tree = self.tree_of(body, imu)
        T_body_imu = None if tree.moves(body, imu) else tree.find(body, imu)
        if found is not None and T_body_imu is not None:
            found = replace(found, R_body_imu=T_body_imu[:3, :3])
        return found, [*notes, *more]

    def gnss(self, series: Series | None, *, body: str) -> tuple[GnssFixes | None, list[str]]:
        """Return the fixes of a topic, with the antenna's place if tf has one that stays, and notes."""
        if series is None:
            return None, []
        frame = frame_of(self.firsts.get(series.topic.name))
        tree = self.tree_of(body, frame)
        T_body_antenna = None if tree.moves(body, frame) else tree.find(body, frame)
        fixes, notes = self._sentences(series) if series.topic.type in SENTENCES else self._fixes(series)
        if fixes is None:
            return None, notes
        antenna = None if T_body_antenna is None else T_body_antenna[:3, 3]
        kept, more = replace(fixes, antenna_body=antenna).without_invalid()
        return kept, [*notes, *more]

    def _fixes(self, series: Series) -> tuple[GnssFixes, list[str]]:
        order, notes = ordered(series)
        found = [(ns, fix) for ns, fix in self._messages(series, order) if isinstance(fix, FixMessage)]
        fixes = GnssFixes(
            series.topic.name,
            np.array([ns for ns, _ in found], np.int64),
            np.array([fix.geodetic for _, fix in found]).reshape(-1, 3),
            np.array([fix.covariance_enu for _, fix in found]).reshape(-1, 3, 3),
            np.array([fix.status for _, fix in found], np.int8),
        )
        return fixes, notes

    def _sentences(self, series: Series) -> tuple[GnssFixes | None, list[str]]:
        """Return the fixes of sentences, those of one moment with one stamp."""
        order = np.argsort(series.stamps_ns, kind="stable")
        found = [(ns, one) for ns, one in self._messages(series, order) if isinstance(one, SentenceMessage)]
        fixes, notes = fixes_from_sentences(series.topic.name, ((ns, one.sentence) for ns, one in found))
        if fixes is None:
            return None, notes
        kept, more = time_order(fixes.stamps_ns, what=series.topic.name)
        return fixes.of(kept), [*notes, *more]

    def base_of(self, frame: str, *, names: Sequence[str] = BASES) -> str | None:
        """Return the frame of the robot that carries a frame; None where tf names none."""
        bases = (one for base in names for one in self.tree.frames if one.rpartition("/")[2] == base)
        tied = [base for base in bases if self.tree.find(base, frame) is not None]
        return max(tied, key=lambda base: shared_namespaces(base, frame), default=None)

    def height_of(self, frame: str) -> float | None:
        """Return how high a frame is above the robot's footprint, metres; None where tf states none."""
        floor = self.base_of(frame, names=(FOOTPRINT,))
        if floor is None or self.tree.moves(floor, frame):
            return None
        T_floor_frame = self.tree.find(floor, frame)
        return None if T_floor_frame is None else float(T_floor_frame[2, 3])

    def _carried(self, poses: Trajectory, child: str, body: str) -> Trajectory:
        """Return the poses of the body for those of the frame that carries it."""
        known, T_child_body = self.tree_of(child, body).find_each(child, body, poses.stamps_ns)
        return Trajectory(poses.stamps_ns[known], poses.T_world_body[known] @ T_child_body)

    def _poses_of(self, series: Series) -> tuple[Trajectory | None, str, list[str]]:
        """Return the poses of a topic in time order, the frame that moves, and notes."""
        order, order_notes = ordered(series)
        poses = list(self._poses(series, order))
        child = next((pose.child.lstrip("/") for pose in poses), "")
        trajectory, pose_notes = _trajectory(poses, what=series.topic.name)
        return trajectory, child, [*order_notes, *pose_notes]

    def _transforms(self, *, most: int | None) -> Iterator[PoseMessage]:
        """Yield the transforms of tf, the static first; of many, enough to name every frame."""
        series = [one for one in self.series.values() if one.topic.type in TRANSFORMS]
        for one in sorted(series, key=lambda one: "static" not in one.topic.name):
            is_static = "static" in one.topic.name
            for recorded_ns, message in self._messages(
                one, _spread(np.arange(len(one)), most=most or len(one))
            ):
                if isinstance(message, list):
                    followed_ns = recorded_ns + self._clock_ns
                    for pose in message:
                        is_near = abs(pose.stamp_ns - followed_ns) <= SAME_CLOCK_NS
                        stamp_ns = 0 if is_static else pose.stamp_ns if is_near else followed_ns
                        yield pose if stamp_ns == pose.stamp_ns else replace(pose, stamp_ns=stamp_ns)

    def _poses(self, series: Series, indices: NDArray[np.intp]) -> Iterator[PoseMessage]:
        for stamp_ns, message in self._messages(series, indices):
            if isinstance(message, list):
                yield from (replace(pose, stamp_ns=stamp_ns) for pose in message)

    def _messages(self, series: Series, indices: NDArray[np.intp]) -> Iterator[tuple[int, Message]]:
        """Yield some of a topic's messages with their stamps in the series; damaged ones are left out."""
        for i in indices.tolist():
            with suppress(FrameError, DataError):
                data = series.kept.get(i) or self.recording.read(series.place(i))
                yield int(series.stamps_ns[i]), decode(series.topic, memoryview(data))


def _spread(indices: NDArray[np.intp], *, most: int) -> NDArray[np.intp]:
    """Return all of the indices, or every n-th where there are more than ``most``."""
    return indices[:: -(-len(indices) // most) or 1]


def _trajectory(poses: Sequence[PoseMessage], *, what: str) -> tuple[Trajectory | None, list[str]]:
    """Return poses that are in time order, and notes on those that had to go."""
    numbers = np.array([pose.numbers for pose in poses], dtype=np.float64).reshape(-1, 7)
    with np.errstate(invalid="ignore", over="ignore"):
        is_rotation = np.abs((numbers[:, 3:] ** 2).sum(axis=1) - 1.0) < ROUNDING
        usable = is_rotation & (np.abs(numbers[:, :3]) < FARTHEST_M).all(axis=1)
    notes = []
    if dropped := int((~usable).sum()):
        notes.append(f"{what}: {dropped} of {len(poses)} poses are not finite rigid motions; dropped")
    if not usable.any():
        return None, [*notes, f"{what}: no usable pose"]
    stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)[usable]
    return Trajectory(stamps_ns, pose_of_row(numbers[usable])), notes


def _untied(base: str | None, body: str) -> str:
    return (
        f"tf does not tie {base or 'it'} to {body}, which is taken to be at its origin, looking forward; a "
        "config file can set source.wheels.body_in_base"
    )
