"""ROS 1 bags read as recordings, whole or cut off (format 2.0, https://wiki.ros.org/Bags/Format/2.0).

A bag's index has the places of its chunks; a bag that was never closed has none, and its records are read
from the start as far as they go.
"""

import bz2
import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame

from mapper.core.errors import DataError
from mapper.core.timebase import NS_PER_S
from mapper.core.units import MIB
from mapper.sources.ros.recording import (
    BlockRecording,
    Contents,
    Part,
    Span,
    Topic,
    check_block_size,
    open_blocks,
    ros2_name,
)

_MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")
_MESSAGE, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 5, 6, 7  # the values of a header's op
_Fields = Mapping[bytes, bytes]


class _Record(NamedTuple):
    """Record of a bag: the fields of its header, and the bytes between which its data lies."""

    fields: _Fields
    start: int
    end: int


def open_bag(path: Path) -> BlockRecording:
    """Return a ROS 1 bag as a recording.

    Raises:
        SourceError: The file is no bag of format 2.0, or cannot be read.
    """
    return open_blocks(
        path,
        kind="rosbag",
        magic=_MAGIC,
        called="ROS 1 bags of format 2.0",
        read_contents=lambda file: _indexed(file) or _walked(file, path),
        unpack=unpack,
    )


class _Contents(Contents):
    """Chunks of a bag, and its connections as far as they have been read."""

    def __init__(self) -> None:
        super().__init__()
        self._topics: dict[bytes, Topic] = {}

    def add_connection(self, fields: _Fields, data: bytes) -> None:
        type_ = ros2_name(_fields(data)[b"type"].decode())
        self._topics[fields[b"conn"]] = Topic(fields[b"topic"].decode(), type_, "ros1")

    def split(self, data: memoryview) -> Iterator[Part]:
        """Yield the messages of a chunk."""
        at = 0
        while at < len(data):
            fields, start, end = _record_in(data, at)
            at = end
            try:
                if fields[b"op"][0] == _CONNECTION:
                    self.add_connection(fields, bytes(data[start:end]))
                elif fields[b"op"][0] == _MESSAGE and fields[b"conn"] in self._topics:
                    sec, nsec = struct.unpack("<II", fields[b"time"])
                    yield Part(self._topics[fields[b"conn"]], sec * NS_PER_S + nsec, start, end - start)
            except (KeyError, struct.error, UnicodeDecodeError) as error:
                raise DataError(f"a damaged record: {error}") from None


def _indexed(file: BinaryIO) -> _Contents | None:
    """Return the contents by the index of a closed bag; None without a whole one."""
    contents = _Contents()
    try:
        size = file.seek(0, os.SEEK_END)
        (at,) = struct.unpack("<Q", _record_at(file, len(_MAGIC), size).fields[b"index_pos"])
        starts: list[int] = []
        contents.expected = 0
        while len(_MAGIC) < at < size:
            fields, start, end = _record_at(file, at, size)
            at = end
            check_block_size(end - start)
            file.seek(start)
            if fields[b"op"][0] == _CONNECTION:
                contents.add_connection(fields, file.read(end - start))
            elif fields[b"op"][0] == _CHUNK_INFO:
                starts += struct.unpack("<Q", fields[b"chunk_pos"])
                counts = struct.iter_unpack("<II", file.read(end - start))
                contents.expected += sum(count for _, count in counts)
        for at in sorted(starts):
            contents.blocks.append(Span(at, _record_at(file, at, size).end - at))
    except (DataError, KeyError, IndexError, struct.error, UnicodeDecodeError):
        return None
    return contents if contents.blocks and contents.are_apart() else None


def _walked(file: BinaryIO, path: Path) -> _Contents:
    """Return the contents by the records, from the start of a bag to its end or the first damaged one."""
    contents = _Contents()
    size = file.seek(0, os.SEEK_END)
    at = len(_MAGIC)
    with suppress(DataError):
        while at < size:
            record = _record_at(file, at, size)
            if not record.fields:  # zeros, as a file system leaves them where a file was cut short
                break
            if record.fields.get(b"op") == bytes([_CHUNK]):
                contents.blocks.append(Span(at, record.end - at))
            at = record.end
    contents.note_cut(path, at=at, size=size)
    return contents


def unpack(stored: bytes) -> memoryview:
    """Return the records of a chunk: a view where they are not compressed."""
    fields, start, end = _record_in(memoryview(stored), 0)
    data = memoryview(stored)[start:end]
    compression = fields.get(b"compression")
    try:
        if compression == b"none":
            return data
        (size,) = _LENGTH.unpack(fields[b"size"])
        check_block_size(size)
        # A byte more than announced, so that a chunk with more of them does not pass for a whole one.
        if compression == b"lz4":
            unpacked = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif compression == b"bz2":
            unpacked = bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
        else:
            raise DataError(f"a chunk compressed as {compression!r:.20}; known are none, lz4 and bz2")
    except (KeyError, struct.error):
        raise DataError("a chunk that does not say what it is") from None
    except (OSError, ValueError, RuntimeError, MemoryError) as error:  # RuntimeError is lz4's
        raise DataError(f"a chunk that cannot be decompressed: {error}") from None
    if len(unpacked) != size:
        raise DataError(f"a chunk of {len(unpacked)} bytes or more, want {size}")
    return memoryview(unpacked)


def _record_at(file: BinaryIO, at: int, size: int) -> _Record:
    """Return the record at a byte of a file."""
    if at > size:
        raise DataError("a record that begins after the file")
    file.seek(at)
    (header_length,) = _LENGTH.unpack(file.read(_LENGTH.size).ljust(_LENGTH.size, b"\xff"))
    start = at + _LENGTH.size + header_length + _LENGTH.size
    if start > size or header_length > MIB:  # it holds a few names and numbers
        raise DataError("a record that ends after the file, or whose header is damaged")
    fields = _fields(file.read(header_length))
    (length,) = _LENGTH.unpack(file.read(_LENGTH.size))
    if start + length > size:
        raise DataError("a record that ends after the file")
    return _Record(fields, start, start + length)


def _record_in(data: memoryview, at: int) -> _Record:
    """Return the record at a byte of a chunk."""
    try:
        (header_length,) = _LENGTH.unpack_from(data, at)
        start = at + 2 * _LENGTH.size + header_length
        (length,) = _LENGTH.unpack_from(data, start - _LENGTH.size)
    except struct.error:
        raise DataError("a chunk that ends within a record") from None
    if start + length > len(data):
        raise DataError("a chunk that ends within a record")
    return _Record(_fields(bytes(data[at + _LENGTH.size : start - _LENGTH.size])), start, start + length)


def _fields(header: bytes) -> _Fields:
    """Return the ``name=value`` fields of a record's header."""
    fields, at = {}, 0
    while at < len(header):
        (length,) = _LENGTH.unpack(header[at : at + _LENGTH.size].ljust(_LENGTH.size, b"\xff"))
        at += _LENGTH.size
        name, equals, value = header[at : at + length].partition(b"=")
        if not equals or at + length > len(header):
            raise DataError("a record whose header is damaged")
        fields[name] = value
        at += length
    return fields
