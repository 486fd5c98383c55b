"""The seam between recorded logs and everything else."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from mapper.core.frames import Frame, Scan, Sensor
from mapper.core.geometry import Array
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory


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
        depth_stamp_ns: Time of the depth image, nanoseconds.
        depth_units_per_m: Depth image units per metre.
    """

    colour: ImageFile
    depth: ImageFile
    depth_stamp_ns: int
    depth_units_per_m: float


class FrameRef(Protocol):
    """One frame of a log that has not been read yet, so that reading can run ahead in other threads."""

    @property
    def stamp_ns(self) -> int:
        """Time of the frame, nanoseconds."""
        ...

    @property
    def files(self) -> ImageFiles | None:
        """The frame's encoded images, where the log has them."""
        ...

    def load(self, *, colour: bool = True) -> Frame:
        """Read and decode the frame; safe in any thread, and the same every time.

        Args:
            colour: False lets an RGB-D source decode a grey image only, which is faster.

        Raises:
            FrameError: This frame cannot be used; the message says which file and why.
        """
        ...

    def scan(self) -> Scan:
        """Read the returns alone: the same points as ``load().scan()``, without the cost of an image.

        Raises:
            FrameError: As ``load``.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Accelerations:
    """Accelerometer readings of a log, in the accelerometer's own axes.

    Attributes:
        stamps_ns: (N,) int64 nanoseconds.
        acceleration_mps2: (N, 3) float64; at rest it points up.
    """

    stamps_ns: Stamps
    acceleration_mps2: Array


class FrameSource(Protocol):
    """A recorded log: the same frames in time order, however often it is read.

    Attributes:
        path: What was opened.
        name: What the log calls itself; the folder's name where it does not say.
        kind: Which format it was recognised as, e.g. "tum".
        sensor: What its frames are.
        truth: Where the body really was, if the log tells.
        accelerations: Accelerometer readings, if the log has them.
        wheels: Where its wheels say the body was, in a frame of their own that drifts, if it has wheels.
        notes: What opening it had to leave out or assume, a sentence each.
    """

    path: Path
    name: str
    kind: str
    sensor: Sensor
    truth: Trajectory | None
    accelerations: Accelerations | None
    wheels: Trajectory | None
    notes: Sequence[str]

    def __len__(self) -> int:
        """Return how many entries there will be."""
        ...

    def entries(self) -> Iterator[FrameRef]:
        """Yield every frame's entry in time order; nothing is decoded yet."""
        ...


@dataclass(frozen=True, slots=True)
class Skipped:
    """A frame that could not be read, and why."""

    stamp_ns: int
    reason: str
