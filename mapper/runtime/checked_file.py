"""Binary files whose version and checksum are checked before anything in them is used."""

import io
import shutil
import struct
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

from mapper.core.errors import MapperError
from mapper.core.units import MIB
from mapper.runtime import atomic

_FIXED = struct.Struct("<III")


@dataclass(frozen=True, slots=True)
class CheckedFormat:
    """Layout: magic; version, length of the header, CRC-32 of header and body (little-endian uint32); both.

    Attributes:
        magic: First bytes of a file: not text, and damaged by whatever takes it for text.
        version: The only one that can be read.
        remedy: Instruction for a file of another version.
        error: Raised for a file that cannot be read.
    """

    magic: bytes
    version: int
    remedy: str
    error: type[MapperError]

    def write(self, path: Path, head: bytes, body: bytes) -> None:
        """Write a header and a body; atomic."""
        self.write_from(path, head, io.BytesIO(body))

    def write_from(self, path: Path, head: bytes, body: BinaryIO) -> None:
        """Write a header and a body that another file has, which is never in memory as a whole; atomic."""
        checksum = zlib.crc32(head)
        body.seek(0)
        for piece in iter(partial(body.read, MIB), b""):
            checksum = zlib.crc32(piece, checksum)
        body.seek(0)
        with atomic.atomic_file(path) as part, part.open("wb") as file:
            file.write(self.magic + _FIXED.pack(self.version, len(head), checksum) + head)
            shutil.copyfileobj(body, file, MIB)

    def split(self, path: Path, data: bytes) -> tuple[bytes, memoryview]:
        """Return header and body of a file's bytes, which begin with the magic.

        Args:
            path: Path of the file, for errors.
            data: All bytes of the file.

        Raises:
            MapperError: ``error``: the file is of another version, truncated or damaged.
        """
        start = len(self.magic) + _FIXED.size
        if len(data) < start:
            raise self.error(f"{path}: ends inside its header; it is truncated")
        version, head_bytes, checksum = _FIXED.unpack_from(data, len(self.magic))
        if version != self.version:
            raise self.error(
                f"{path}: is of version {version}, only {self.version} can be read; {self.remedy}"
            )
        rest = memoryview(data)[start:]
        if zlib.crc32(rest) != checksum:
            raise self.error(f"{path}: its checksum does not match; it is truncated or damaged")
        return bytes(rest[:head_bytes]), rest[head_bytes:]
