"""MCAP files read as recordings, whole or cut off (https://mcap.dev/spec).

A whole file's summary has the places of its chunks; where there is none (the recorder was killed, the file
was cut), the records are walked from the start as far as they go. A damaged chunk costs itself only.
"""

import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from mapper.core.errors import DataError
from mapper.runtime.regular_files import MOST_BYTES, MOST_UNPACKED_RATIO
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

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # first, last time, unpacked size and CRC, length of the compression's name
_CHUNK_INDEX = struct.Struct("<QQQQ")  # first, last time, place and length of the chunk's record
_STATISTICS = struct.Struct("<Q2x4x4x4xI")  # messages, of the counts of other records that of chunks
_FOOTER = struct.Struct("<BQQQI")  # a whole record: opcode, length, places of summary and its offsets, CRC


def open_mcap(path: Path) -> BlockRecording:
    """Return an MCAP file as a recording.

    Raises:
        SourceError: The file is no MCAP file, or cannot be read.
    """
    return open_blocks(
        path,
        kind="mcap",
        magic=_MAGIC,
        called="MCAP files",
        read_contents=lambda file: _summarised(file) or _walked(file, path),
        unpack=unpack,
    )


class _Contents(Contents):
    """Blocks of a file, and its channels as far as they have been read."""

    def __init__(self) -> None:
        super().__init__()
        self._schemas: dict[int, str] = {}
        self._topics: dict[int, Topic] = {}

    def _add_channel(self, channel: Channel) -> None:
        type_ = ros2_name(self._schemas.get(channel.schema_id, ""))  # of a bag that was converted
        self._topics[channel.id] = Topic(channel.topic, type_, channel.message_encoding)

    def split(self, data: memoryview) -> Iterator[Part]:
        """Yield the messages of a chunk, or of a lone record outside of any."""
        for opcode, start, length in _records(data):
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE.size:
                    raise DataError(f"a message record of {length} bytes, want {_MESSAGE.size} or more")
                channel, _, log_ns, _ = _MESSAGE.unpack_from(data, start)
                if channel in self._topics:  # else the chunk that defines it is lost
                    yield Part(self._topics[channel], log_ns, start + _MESSAGE.size, length - _MESSAGE.size)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.add_definition(opcode, bytes(data[start : start + length]))

    def add_definition(self, opcode: int, record: bytes) -> None:
        """Keep a schema or a channel.

        Raises:
            DataError: It is damaged.
        """
        stream = ReadDataStream(BytesIO(record))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema.name
            else:
                self._add_channel(Channel.read(stream))
        except (McapError, struct.error, UnicodeDecodeError) as error:
            raise DataError(f"a damaged schema or channel: {error}") from None


def _summarised(file: BinaryIO) -> _Contents | None:
    """Return the contents by the summary at the end of a file; None without one, or if it is damaged."""
    contents = _Contents()
    chunk_count = -1
    try:
        summary, end = _summary(file)
        for opcode, start, length in _records(summary):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                contents.add_definition(opcode, bytes(summary[start : start + length]))
            elif opcode == Opcode.CHUNK_INDEX:
                _, _, at, chunk_length = _CHUNK_INDEX.unpack_from(summary, start)
                contents.blocks.append(Span(at, chunk_length))
            elif opcode == Opcode.STATISTICS:
                contents.expected, chunk_count = _STATISTICS.unpack_from(summary, start)
    except (DataError, struct.error):
        return None
    contents.blocks.sort()
    is_sound = (
        contents.blocks
        and chunk_count == len(contents.blocks)
        and contents.are_apart()
        and sum(contents.blocks[-1]) <= end
        and all(_is_chunk(file, span) for span in contents.blocks)
    )
    return contents if is_sound else None


def _summary(file: BinaryIO) -> tuple[memoryview, int]:
    """Return the records of a file's summary, and where it begins.

    Raises:
        DataError: There is none, or its place or its checksum is wrong.
    """
    size = file.seek(0, os.SEEK_END)
    end = max(size - len(_MAGIC) - _FOOTER.size, len(_MAGIC))
    file.seek(end)
    footer = file.read(_FOOTER.size)
    if len(footer) < _FOOTER.size or file.read() != _MAGIC:
        raise DataError("a file that was cut off")
    opcode, length, start, _, crc = _FOOTER.unpack(footer)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _RECORD.size):
        raise DataError("a file whose footer is damaged")
    if not (len(_MAGIC) <= start < end and end - start <= MOST_BYTES):
        raise DataError("a file without a summary")
    file.seek(start)
    summary = file.read(end - start)
    if crc and isal_zlib.crc32(footer[:-4], isal_zlib.crc32(summary)) != crc:
        raise DataError("a summary whose checksum is wrong")
    return memoryview(summary), start


def _is_chunk(file: BinaryIO, span: Span) -> bool:
    """Return whether a chunk of this length lies there."""
    file.seek(span.start)
    header = file.read(_RECORD.size)
    return len(header) == _RECORD.size and _RECORD.unpack(header) == (
        Opcode.CHUNK,
        span.length - _RECORD.size,
    )


def _walked(file: BinaryIO, path: Path) -> _Contents:
    """Return the contents by the records, from the start of a file to its end or the first damaged one."""
    contents = _Contents()
    size = file.seek(0, os.SEEK_END)
    at = file.seek(len(_MAGIC))
    is_whole = False
    while at + _RECORD.size <= size:
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        if opcode == 0 or at + _RECORD.size + length > size:  # zeros: what was not written to its end
            break
        if opcode == Opcode.DATA_END:
            is_whole = True
            break
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            contents.blocks.append(Span(at, _RECORD.size + length))
        at = file.seek(at + _RECORD.size + length)
    if not is_whole:
        contents.note_cut(path, at=at, size=size)
    return contents


def unpack(stored: bytes) -> memoryview:
    """Return the records of a chunk; any other record is its own content."""
    if len(stored) < _RECORD.size:
        raise DataError("a chunk beyond the end of the file")
    opcode, length = _RECORD.unpack_from(stored)
    if opcode != Opcode.CHUNK:
        return memoryview(stored)
    at = _RECORD.size
    if length < _CHUNK.size:
        raise DataError(f"a chunk of {length} bytes, want {_CHUNK.size} or more")
    _, _, size, crc, name_length = _CHUNK.unpack_from(stored, at)
    at += _CHUNK.size
    compression = stored[at : at + name_length]
    packed = memoryview(stored)[at + name_length + 8 :]  # the length of what follows: all of it
    check_block_size(size)
    data = _decompressed(packed, compression, size)
    if len(data) != size:
        raise DataError(f"a chunk of {len(data)} bytes, want {size}")
    if crc and isal_zlib.crc32(data) != crc:
        raise DataError("a chunk whose checksum is wrong")
    return data


def _decompressed(packed: memoryview, compression: bytes, size: int) -> memoryview:
    """Return the unpacked bytes of a chunk; of a damaged one hardly more than the size it states."""
    try:
        if compression == b"":
            return packed
        if compression == b"zstd":
            if zstandard.frame_content_size(packed) not in (-1, size):  # -1: the frame does not say
                raise DataError(f"a chunk of {size} bytes whose content states another size")
            return memoryview(zstandard.decompress(packed, max_output_size=size))
        if compression == b"lz4":
            if size > MOST_UNPACKED_RATIO * len(packed):
                raise DataError(f"a chunk of {len(packed)} bytes that LZ4 cannot have made of {size}")
            return memoryview(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:  # RuntimeError is lz4's
        raise DataError(f"a chunk that cannot be decompressed: {error}") from None
    raise DataError(f"a chunk compressed as {compression!r:.20}; known are zstd and lz4")


def _records(data: memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and length of every record's body."""
    at = 0
    while at < len(data):
        if at + _RECORD.size > len(data):
            raise DataError("a chunk that ends within a record")
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + length > len(data):
            raise DataError("a chunk that ends within a record")
        yield opcode, at, length
        at += length
