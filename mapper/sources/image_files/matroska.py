"""Matroska files (RFC 9559): tracks, attachments, and where the blocks of each track lie.

Libraries that read it return packets in the order of the file, and not where their bytes are; frames of a log
are read in any order, by several threads.
"""

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mapper.core.errors import SourceError
from mapper.core.timebase import LATEST_NS
from mapper.core.units import MIB
from mapper.sources.image_files.decoded import FilePart

MAGIC = b"\x1aE\xdf\xa3"
"""First bytes of a file: the number of the element EBML (RFC 8794)."""
_SEGMENT, _INFO, _TRACKS, _TRACK, _VIDEO = 0x18538067, 0x1549A966, 0x1654AE6B, 0xAE, 0xE0
_ATTACHMENTS, _ATTACHED_FILE, _CLUSTER, _BLOCK_GROUP = 0x1941A469, 0x61A7, 0x1F43B675, 0xA0
_ENTERED = {_SEGMENT, _INFO, _TRACKS, _TRACK, _VIDEO, _ATTACHMENTS, _ATTACHED_FILE, _CLUSTER, _BLOCK_GROUP}
_SCALE, _DATE, _CLUSTER_TIME = 0x2AD7B1, 0x4461, 0xE7
_TRACK_NUMBER, _TRACK_NAME, _CODEC_PRIVATE, _WIDTH, _HEIGHT = 0xD7, 0x536E, 0x63A2, 0xB0, 0xBA
_FILE_NAME, _FILE_DATA = 0x466E, 0x465C
_READ = {
    *(_SCALE, _DATE, _CLUSTER_TIME, _TRACK_NUMBER, _TRACK_NAME, _CODEC_PRIVATE, _WIDTH, _HEIGHT),
    *(_FILE_NAME, _FILE_DATA),
}
_BLOCKS = {0xA3, 0xA1}  # SimpleBlock, and Block of a BlockGroup
_MOST_BYTES = MIB  # of an element or a sample that is read whole
_HEAD_BYTES, _CHUNK_BYTES = 16, 1 << 14  # two numbers of variable length; read at once
_EPOCH_NS = 978_307_200 * 10**9  # 2001-01-01, from which dates count


@dataclass(slots=True)
class Track:
    """A track and its blocks.

    Attributes:
        name: Its name.
        codec_private: Data of its codec.
        width_px: Width of its images; 0 of other tracks.
        height_px: Height of them.
        stamps_ns: Time of each block since the epoch if the file has a date, else since its beginning.
        images: Where the blocks are, of a track of images.
        samples: Their data, of other tracks.
    """

    name: str = ""
    codec_private: bytes = b""
    width_px: int = 0
    height_px: int = 0
    stamps_ns: "array[int]" = field(default_factory=lambda: array("q"))
    images: list[FilePart] = field(default_factory=list)
    samples: list[bytes] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class MatroskaFile:
    """Contents of a file.

    Attributes:
        tracks: By name, in the order of the file.
        attachments: Data by file name.
        is_cut_off: The file ends within an element.
    """

    tracks: Mapping[str, Track]
    attachments: Mapping[str, bytes]
    is_cut_off: bool


def read_matroska(path: Path) -> MatroskaFile:
    """Return what a file contains; of the blocks of images only their heads are read.

    Raises:
        SourceError: It cannot be read, or is no Matroska file.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise SourceError(f"{path}: no Matroska file: it does not begin with its mark")
            return _Reader(file, path).read()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None


class _Reader:
    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path, self._size = file, path, path.stat().st_size
        self._chunk, self._chunk_start = b"", 0
        self._tracks: dict[int, Track] = {}
        self._track = Track()
        self._attachments: dict[str, bytes] = {}
        self._file_name = ""
        self._scale_ns, self._date_ns, self._cluster_time = 1_000_000, 0, 0

    def read(self) -> MatroskaFile:
        """Go through the elements: those with others inside are entered, so that their size is not needed."""
        position = 0
        while position < self._size:
            head = self._bytes(position, _HEAD_BYTES)
            element, after = _number(head, 0, keeps_marker=True)
            size, after = _number(head, after)
            start = position + after
            if element is None or size is None:
                break
            if element in _ENTERED:
                position = start
                if element == _TRACK:
                    self._track = Track()
                continue
            if start + size > self._size:
                break
            position = start + size
            if element in _BLOCKS:
                self._add_block(start, size)
            elif element in _READ and size <= _MOST_BYTES:
                self._set(element, self._bytes(start, size))
        tracks = {track.name: track for track in self._tracks.values()}
        return MatroskaFile(tracks, self._attachments, is_cut_off=position < self._size)

    def _bytes(self, position: int, size: int) -> bytes:
        """Return bytes of the file, fewer at its end; it is read ahead, as most elements are small."""
        first = position - self._chunk_start
        if first < 0 or first + size > len(self._chunk):
            self._file.seek(position)
            self._chunk, self._chunk_start, first = self._file.read(max(size, _CHUNK_BYTES)), position, 0
        return self._chunk[first : first + size]

    def _add_block(self, start: int, size: int) -> None:
        head = self._bytes(start, _HEAD_BYTES)
        number, after = _number(head, 0)
        data, data_bytes = start + after + 3, size - after - 3  # two bytes of time and one of flags
        track = self._tracks.get(-1 if number is None else number)
        if track is None or data_bytes < 0 or (not track.width_px and data_bytes > _MOST_BYTES):
            return
        ticks = self._cluster_time + int.from_bytes(head[after : after + 2], signed=True)
        stamp_ns = self._date_ns + ticks * self._scale_ns
        if not 0 <= stamp_ns <= LATEST_NS:
            raise SourceError(f"{self._path}: a block's time is {stamp_ns} ns, not within 0 … {LATEST_NS}")
        track.stamps_ns.append(stamp_ns)
        if track.width_px:
            track.images.append(FilePart(self._path, data, data_bytes, ""))
        else:
            track.samples.append(self._bytes(data, data_bytes))

    def _set(self, element: int, data: bytes) -> None:
        number, text = int.from_bytes(data[:8]), data.rstrip(b"\0").decode(errors="replace")
        if element == _SCALE:
            self._scale_ns = number
        elif element == _DATE:
            self._date_ns = _EPOCH_NS + number
        elif element == _CLUSTER_TIME:
            self._cluster_time = number
        elif element == _TRACK_NUMBER:
            self._tracks[number] = self._track
        elif element == _TRACK_NAME:
            self._track.name = text
        elif element == _CODEC_PRIVATE:
            self._track.codec_private = data
        elif element == _WIDTH:
            self._track.width_px = number
        elif element == _HEIGHT:
            self._track.height_px = number
        elif element == _FILE_NAME:
            self._file_name = text
        elif element == _FILE_DATA:
            self._attachments[self._file_name] = data


def _number(data: bytes, at: int, *, keeps_marker: bool = False) -> tuple[int | None, int]:
    """Return a number of variable length (RFC 8794, §4), None where there is none, and the place after it."""
    more = 8 - data[at].bit_length() if at < len(data) else 8
    after = at + more + 1
    if more == 8 or after > len(data):
        return None, at
    value = int.from_bytes(data[at:after])
    return value if keeps_marker else value & ((1 << 7 * (more + 1)) - 1), after
