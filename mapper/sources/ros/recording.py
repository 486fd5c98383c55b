"""Files of recorded messages: raw messages, and where each lies."""

import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from mapper.core.errors import DataError, FrameError, SourceError
from mapper.core.units import MIB
from mapper.runtime.regular_files import MOST_BYTES, MOST_UNPACKED_RATIO

_CACHE_BYTES = 64 * MIB


@dataclass(frozen=True, slots=True)
class Topic:
    """Stream of messages.

    Attributes:
        name: E.g. "/camera/color/image_raw".
        type: Type of its messages, as ROS 2 or Foxglove call it, e.g. "sensor_msgs/msg/Image".
        encoding: Encoding of its messages: "cdr", "ros1", "protobuf", "json" or another that is not read.
    """

    name: str
    type: str
    encoding: str


def ros2_name(type_: str) -> str:
    """Return what ROS 2 calls a message type of ROS 1: "sensor_msgs/msg/Image" for "sensor_msgs/Image".

    Copies of Livox' CustomMsg in other packages are called as the first is; their size tells if they are any.
    """
    package, slash, name = type_.partition("/")
    if slash and name.rpartition("/")[2] == "CustomMsg":
        return "livox_ros_driver/msg/CustomMsg"
    return type_ if not slash or "/" in name else f"{package}/msg/{name}"


class Place(NamedTuple):
    """Place of a message's bytes: the block of the recording, and the bytes within it."""

    block: int
    offset: int
    length: int


class Recorded(NamedTuple):
    """Raw message, as the recorder wrote it at ``log_ns``."""

    topic: Topic
    log_ns: int
    place: Place
    data: memoryview


class Recording(Protocol):
    """File of messages, read once from end to end, and then a message at a time."""

    @property
    def path(self) -> Path:
        """Return what was opened."""
        ...

    @property
    def kind(self) -> str:
        """Return "mcap", "rosbag" or "rosbag2"."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """Return what was lost, a sentence each; complete once ``messages`` has ended."""
        ...

    def messages(self) -> Iterator[Recorded]:
        """Yield every message that can be read, in the order of the file."""
        ...

    def read(self, place: Place) -> memoryview:
        """Return a message's bytes; safe in any thread.

        Raises:
            FrameError: The file has changed or cannot be read any more.
        """
        ...


class Span(NamedTuple):
    """Bytes of a file."""

    start: int
    length: int


class Part(NamedTuple):
    """Message within a block's unpacked bytes."""

    topic: Topic
    log_ns: int
    offset: int
    length: int


class Contents(ABC):
    """Blocks of a recording, and the messages in them; a subclass for each format of files.

    Attributes:
        blocks: Places of the blocks, in the order of the file.
        expected: Number of messages that the file says it holds, if it says so.
        notes: Sentences on what is lost already.
    """

    def __init__(self) -> None:
        self.blocks: list[Span] = []
        self.expected: int | None = None
        self.notes: list[str] = []

    @abstractmethod
    def split(self, data: memoryview) -> Iterator[Part]:
        """Yield the messages of an unpacked block.

        Raises:
            DataError: It is damaged from here on.
        """

    def note_cut(self, path: Path, *, at: int, size: int) -> None:
        """Add a note that a file of ``size`` bytes has no index, and no whole record from ``at`` on."""
        self.notes.append(
            f"{path.name}: the recording was cut off: no index, and {size - at} of {size} bytes at its end "
            "are no whole record; read as far as it goes"
        )

    def are_apart(self) -> bool:
        """Return whether every block ends before the next begins: a damaged index may name one many times."""
        return all(a.start + a.length <= b.start for a, b in pairwise(self.blocks))


class BlockRecording:
    """Recording made of blocks that are each stored, compressed and checked on their own."""

    def __init__(
        self, path: Path, *, kind: str, contents: Contents, unpack: Callable[[bytes], memoryview]
    ) -> None:
        """Keep what a format's module has found in a file.

        Args:
            path: The file.
            kind: Format, as of :class:`Recording`.
            contents: Its blocks.
            unpack: Returns the bytes of a stored block; DataError if they are damaged.
        """
        self.path = path
        self.kind = kind
        self.notes = list(contents.notes)
        self._contents = contents
        self._unpack = unpack
        self._unpacked: OrderedDict[int, memoryview] = OrderedDict()
        self._lock = threading.Lock()

    def messages(self) -> Iterator[Recorded]:
        """Yield every message that can be read, in the order of the file."""
        count = damaged = damaged_bytes = unpacked_bytes = 0
        blocks, expected = self._contents.blocks, self._contents.expected
        most_bytes = max(MOST_UNPACKED_RATIO * self.path.stat().st_size, MOST_BYTES)
        for number, span in enumerate(blocks):
            if unpacked_bytes > most_bytes:
                self.notes.append(
                    f"{self.path.name}: {number} of {len(blocks)} chunks unpack to {unpacked_bytes} bytes, "
                    f"more than {MOST_UNPACKED_RATIO} times the file's size; read no further"
                )
                break
            try:
                data = self._load(number)
                unpacked_bytes += len(data)
                for topic, log_ns, offset, length in self._contents.split(data):
                    count += 1
                    place = Place(number, offset, length)
                    yield Recorded(topic, log_ns, place, data[offset : offset + length])
            except DataError:
                damaged += 1
                damaged_bytes += span.length
        if damaged:
            lost = f"{damaged} of {len(blocks)} chunks are damaged: {damaged_bytes} bytes"
            if expected is not None:
                lost += f" with {expected - count} of {expected} messages"
            self.notes.append(f"{self.path.name}: {lost} lost")

    def read(self, place: Place) -> memoryview:
        """Return a message's bytes; safe in any thread.

        The blocks read last are kept unpacked, as many as fit into 64 MiB.

        Raises:
            FrameError: The block is damaged or cannot be read any more.
        """
        try:
            with self._lock:  # else two threads would unpack the same block
                block = self._block(place.block)
        except DataError as error:
            raise FrameError(f"{self.path}: {error}") from None
        return block[place.offset : place.offset + place.length]

    def _block(self, number: int) -> memoryview:
        if number not in self._unpacked:
            self._unpacked[number] = self._load(number)
            while len(self._unpacked) > 1 and sum(map(len, self._unpacked.values())) > _CACHE_BYTES:
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(number)
        return self._unpacked[number]

    def _load(self, number: int) -> memoryview:
        start, length = self._contents.blocks[number]
        check_block_size(length)
        try:
            with self.path.open("rb") as file:
                file.seek(start)
                stored = file.read(length)
        except OSError as error:
            raise DataError(f"cannot be read: {error.strerror}") from None
        return self._unpack(stored)


def check_block_size(size: int) -> None:
    """Refuse a block that is stored in, or announces, too many bytes.

    Raises:
        DataError: They are more than ``MOST_BYTES``.
    """
    if size > MOST_BYTES:
        raise DataError(f"a chunk of {size} bytes; more than {MOST_BYTES} are taken for damage")


def open_blocks(
    path: Path,
    *,
    kind: str,
    magic: bytes,
    called: str,
    read_contents: Callable[[BinaryIO], Contents],
    unpack: Callable[[bytes], memoryview],
) -> BlockRecording:
    """Return a file as a recording.

    Args:
        path: The file.
        kind: Format, as of :class:`Recording`.
        magic: Bytes that every file of the format begins with.
        called: The format's files, for messages.
        read_contents: Finds the blocks of an open file.
        unpack: Function as of :class:`BlockRecording`.

    Raises:
        SourceError: The file does not begin as it should, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(magic)) != magic:
                raise SourceError(f"{path}: does not begin as {called} do; is it damaged, or another format?")
            file.seek(0)
            contents = read_contents(file)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
    return BlockRecording(path, kind=kind, contents=contents, unpack=unpack)
