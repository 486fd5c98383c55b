"""Recorded logs, whatever their format: frames that are not read yet, and what else a log holds."""

from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, Self, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import Frame, Image, PinholeCamera, RgbdFrame, Scan, Sensor
from mapper.core.geometry import Array, Transform, inverse
from mapper.core.timebase import Stamps
from mapper.core.trajectory import NO_POSES, Trajectory, carried
from mapper.sensing.config import DepthNoiseConfig
from mapper.sensing.gnss import GnssFixes
from mapper.sensing.gyroscope import Gyroscope

SPREAD_FRAMES = 24
"""Frames, spread over a log, by which its sensor is judged."""


class ImageFile(Protocol):
    """An encoded image: a ``Path``, or a message that has one."""

    @property
    def suffix(self) -> str:
        """Return which format it is in, as a file's ending: ".png"."""
        ...

    def read_bytes(self) -> bytes:
        """Return the file's bytes.

        Raises:
            OSError: It cannot be read; so says a ``Path``.
            FrameError: It cannot be read; so says a message.
        """
        ...


@dataclass(frozen=True, slots=True)
class ImageFiles:
    """The encoded images of an RGB-D frame, so that a log can be converted without decoding them.

    Attributes:
        colour: Colour image.
        depth: 16-bit depth image.
        depth_units_per_m: Depth image units per metre.
        colour_px: Width and height of the colour image; None if they are the frame's.
        depth_px: As ``colour_px``, of the depth image.
        recorded_units_per_m: Units per metre of the recording that it is encoded from; None if they are the
            same.
    """

    colour: ImageFile
    depth: ImageFile
    depth_units_per_m: float
    colour_px: tuple[int, int] | None
    depth_px: tuple[int, int] | None
    recorded_units_per_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrameRef:
    """One frame of a log that has not been read yet, so that reading can run ahead in other threads.

    Attributes:
        stamp_ns: Time of the frame, nanoseconds.
        read: Returns the frame, as ``load``. Where its argument is false an image may be grey, and a scan has
            neither colours nor intensities.
        returns: Returns what ``scan`` does, where that is less work than the frame; None takes the frame's.
        depth_delay_ns: Time from the frame to its depth image, nanoseconds.
        files: The frame's encoded images, where the log has them.
    """

    stamp_ns: int
    read: Callable[[bool], Frame]
    returns: Callable[[], Scan] | None = None
    depth_delay_ns: int = 0
    files: ImageFiles | None = None

    @property
    def depth_stamp_ns(self) -> int:
        """Time of the depth image, nanoseconds; the frame's where it has no other."""
        return self.stamp_ns + self.depth_delay_ns

    def load(self, *, colour: bool = True) -> Frame:
        """Read and decode the frame; safe in any thread, and the same every time.

        Args:
            colour: False lets an RGB-D source decode a grey image only, which is faster.

        Raises:
            FrameError: This frame cannot be used; the message says which file and why.
        """
        return self.read(colour)

    def scan(self) -> Scan:
        """Read the returns alone, without the cost of an image.

        They are the points of ``load().scan()``; of a depth camera beside the colour camera, all of its
        returns along its own rays.

        Raises:
            FrameError: As ``load``.
        """
        return self.read(False).scan() if self.returns is None else self.returns()


@dataclass(frozen=True, slots=True, eq=False)
class Accelerations:
    """Accelerometer readings of a log.

    Attributes:
        stamps_ns: (N,) int64 nanoseconds.
        acceleration_mps2: (N, 3) float64; at rest it points up.
        are_axes_stated: The axes are the body's, as the log says; else they may be a permutation of them.
        place_body: (3,) position of the unit in the body, metres; None if the log does not state it.
        are_checked: The axes are the body's and the sign is right, as turns and changes of velocity show.
    """

    stamps_ns: Stamps
    acceleration_mps2: Array
    are_axes_stated: bool = False
    place_body: Array | None = None
    are_checked: bool = False


Readings = TypeVar("Readings", Trajectory, Gyroscope, Accelerations, GnssFixes)
"""What a log has at stamps of its own, in ``stamps_ns``."""


def later(readings: Readings | None, shift_ns: int) -> Readings | None:
    """Return readings whose stamps are raised."""
    return readings and replace(readings, stamps_ns=readings.stamps_ns + shift_ns)


@dataclass(frozen=True, slots=True, eq=False)
class CameraImages:
    """Images of a camera beside the sensor that is mapped.

    Attributes:
        name: Name of their topic or folder.
        stamps_ns: (N,) int64 time of each image, nanoseconds, increasing.
        camera: Camera of the images as ``image_at`` returns them.
        T_body_camera: (4, 4) pose of the camera in the body.
        image_at: Returns image 0 … N − 1, (H, W, 3) RGB or (H, W) grey; safe in any thread; raises
            ``FrameError`` where it cannot be read.
    """

    name: str
    stamps_ns: Stamps
    camera: PinholeCamera
    T_body_camera: Transform
    image_at: Callable[[int], Image]

    @property
    def choice(self) -> str:
        """What they are used for, in a sentence."""
        return f"the cloud gets its colours from {self.name}"


@dataclass(frozen=True, slots=True, eq=False)
class SensorBeside:
    """A sensor beside the one that is tracked, which is fused at the poses of its path.

    Attributes:
        log: The sensor's frames, in a body of its own.
        T_body_sensor: (4, 4) pose of that body in the tracked one.
    """

    log: "Log"
    T_body_sensor: Transform


@dataclass(frozen=True, slots=True, eq=False)
class MountedSensor:
    """Mounting of a sensor on the robot, by the log.

    Attributes:
        frame: Name of its coordinate frame.
        parent: Name of the frame on which it stays: the body, or the base where the body moves on that.
        T_parent_sensor: (4, 4) its pose there.
    """

    frame: str
    parent: str
    T_parent_sensor: Transform


FOOTPRINT = "base_footprint"
"""Frame of a robot on the floor (REP 120)."""
BASES = ("base_link", FOOTPRINT)
"""Frames of a robot's base (REP 105, REP 120); with several robots each has a namespace before them."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Log:
    """A recorded log: the same frames in time order, however often it is read.

    Attributes:
        path: File or folder that was opened.
        name: Name that the log gives itself; the folder's name where it does not say.
        kind: Format that it was recognised as, e.g. "tum".
        sensor: Sensor that took its frames.
        stamps_ns: (N,) time of every frame, nanoseconds, strictly increasing.
        entry_at: Returns the entry of frame 0 … N - 1; nothing is decoded yet.
        truth: True T_world_body, if the log has it.
        device_poses: T_world_body as a phone or tablet estimated it, if the log has it.
        accelerations: Accelerometer readings, if the log has them.
        gyroscope: Gyroscope readings, if the log has them.
        gnss: Fixes of a GNSS receiver, if the log has them.
        images: Images of the cameras beside a LiDAR, which colour its cloud.
        beside: Sensors whose frames are fused too; no two frames, nor one of the log, have the same stamp.
        T_base_body: Mounting of the body on the robot, whose base has x forward and z up (REP 103), if the
            log states it and it does not move there.
        T_body_base: Poses of the base in the body, at the frames' stamps, where they move and it is known.
        base_frame: Name of the robot's base in the log.
        base_height_m: Height of its origin above the floor, if the log states it.
        body_frame: Name of the body in the log.
        sensors: Where its other sensors are on the robot, used or not.
        wheels: T_odom_body by wheel odometry, in a frame of its own that drifts, if the log has it.
        depth_noise: Noise of its depth, if what made it states it.
        are_units_assumed: Nothing says how many units of its depth images a metre has.
        choices: Sentences on which of its topics and files are used, where that was chosen.
        notes: Sentences on what opening it left out or assumed.
        sessions: The logs that a chained log is made of, oldest first; empty for any other.
    """

    path: Path
    name: str
    kind: str
    sensor: Sensor
    stamps_ns: Stamps
    entry_at: Callable[[int], FrameRef]
    truth: Trajectory | None = None
    device_poses: Trajectory | None = None
    accelerations: Accelerations | None = None
    gyroscope: Gyroscope | None = None
    gnss: GnssFixes | None = None
    images: Sequence[CameraImages] = ()
    beside: Sequence[SensorBeside] = ()
    T_base_body: Transform | None = None
    T_body_base: Trajectory = NO_POSES
    base_frame: str = ""
    base_height_m: float | None = None
    body_frame: str = ""
    sensors: Sequence[MountedSensor] = ()
    wheels: Trajectory | None = None
    depth_noise: DepthNoiseConfig | None = None
    are_units_assumed: bool = False
    choices: Sequence[str] = ()
    notes: Sequence[str] = ()
    sessions: "Sequence[Session]" = ()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def sentences(self) -> Sequence[str]:
        """All that is reported when it is opened: choices and notes."""
        return [*self.choices, *self.notes]

    @property
    def has_colours(self) -> bool:
        """Whether points of the cloud have the colours of images."""
        return self.sensor == "rgbd" or len(self.images) > 0

    def base_poses(self, trajectory: Trajectory) -> Trajectory:
        """Return the poses of the robot's base for those of the body, where the log tells them."""
        T_body_base = self.T_body_base if self.T_base_body is None else inverse(self.T_base_body)
        return carried(trajectory, T_body_base)

    def __enter__(self) -> Self:
        """Return the log itself: nothing stays open between its frames."""
        return self

    def __exit__(self, *_: object) -> None: ...

    def __iter__(self) -> Iterator[Frame]:
        """Yield every frame in time order, read and decoded; ``entries`` reads none by itself.

        Raises:
            FrameError: A frame cannot be read.
        """
        return (entry.load() for entry in self.entries())

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> "Log": ...

    def __getitem__(self, index: int | slice) -> "Frame | Log":
        """Return a frame, read and decoded, counted from 0, or from the end if negative; or part of the log.

        Raises:
            IndexError: There is no such frame.
            FrameError: It cannot be read.
            DataError: The part would run backwards.
        """
        if isinstance(index, slice):
            if index.step is not None and index.step < 0:
                raise DataError(f"{self.path}: frames {index}: a log has no backward order; want a step > 0")
            return self.subset(np.arange(len(self))[index])
        return self.entry_at(range(len(self))[index]).load()

    def entries(self) -> Iterator[FrameRef]:
        """Yield every frame's entry in time order; nothing is decoded yet."""
        return map(self.entry_at, range(len(self)))

    def entries_of(self, stamps_ns: Container[int]) -> Iterator[FrameRef]:
        """Yield the entries of the frames with some stamps, in time order."""
        stamps = enumerate(self.stamps_ns.tolist())
        return (self.entry_at(index) for index, stamp_ns in stamps if stamp_ns in stamps_ns)

    def entry_of(self, stamp_ns: int) -> FrameRef:
        """Return the entry of the frame with a stamp; there is one."""
        return self.entry_at(int(np.searchsorted(self.stamps_ns, stamp_ns)))

    def spread_indices(self, most: int) -> list[int]:
        """Return the indices of at most ``most`` frames, evenly spread over the log."""
        spread = np.linspace(0, len(self) - 1, min(most, len(self))).round().astype(int)
        indices: list[int] = np.unique(spread).tolist()
        return indices

    def spread_entries(self, most: int) -> Iterator[FrameRef]:
        """Yield the entries of at most ``most`` frames, evenly spread over the log."""
        return map(self.entry_at, self.spread_indices(most))

    def with_frames(self, change: Callable[[Frame], Frame]) -> "Log":
        """Return the log with what a function makes of each frame or scan that is read.

        Encoded images stay as they were recorded. The function raises ``FrameError`` where nothing is left.
        """

        def entry_at(index: int) -> FrameRef:
            entry = self.entry_at(index)
            return replace(
                entry,
                read=lambda colour: change(entry.read(colour)),
                returns=lambda: change(entry.scan()).scan(),
            )

        return replace(self, entry_at=entry_at)

    def subset(self, indices: NDArray[np.intp]) -> "Log":
        """Return the log with only the frames of some increasing indices; all else stays as it is."""
        stamps_ns = self.stamps_ns[indices]
        return replace(
            self,
            stamps_ns=stamps_ns,
            entry_at=lambda index: self.entry_at(int(indices[index])),
            T_body_base=self.T_body_base[np.isin(self.T_body_base.stamps_ns, stamps_ns)],
        )


def read_depth(entry: FrameRef) -> RgbdFrame | None:
    """Return a frame with its depth and without colour; None if it cannot be read or is a scan."""
    try:
        frame = entry.load(colour=False)
    except FrameError:
        return None
    return frame if isinstance(frame, RgbdFrame) else None


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """One of the logs of a chain.

    Attributes:
        log: The log, on the clock of the chain.
        shift_ns: Nanoseconds that were added to its own stamps.
    """

    log: Log
    shift_ns: int


@dataclass(frozen=True, slots=True)
class Skipped:
    """A frame that could not be read, and why."""

    stamp_ns: int
    reason: str
