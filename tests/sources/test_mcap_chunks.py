"""Chunks of MCAP files whose stated size is wrong."""

import struct

import lz4.frame
import pytest
import zstandard

from mapper.core.errors import DataError
from mapper.sources.ros.mcap_file import unpack

CONTENT = bytes(range(256)) * 400
PACK = {b"lz4": lz4.frame.compress, b"zstd": zstandard.compress, b"": bytes}


def chunk(compression, *, size):
    """A chunk record (MCAP, "Chunk") that says that its content is of a size."""
    packed = PACK[compression](CONTENT)
    body = struct.pack("<QQQII", 0, 1, size, 0, len(compression)) + compression
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


@pytest.mark.parametrize("compression", PACK)
def test_a_whole_chunk_is_unpack(compression):
    assert bytes(unpack(chunk(compression, size=len(CONTENT)))) == CONTENT


@pytest.mark.parametrize("compression", PACK)
@pytest.mark.parametrize("size", [0, 100, len(CONTENT) - 1, len(CONTENT) + 1, 1 << 20, 1 << 62])
def test_a_chunk_of_another_size_than_it_says_is_damaged(compression, size):
    with pytest.raises(DataError, match="chunk"):
        unpack(chunk(compression, size=size))


def test_a_bomb_is_not_unpacked_to_its_end():
    bomb = lz4.frame.compress(bytes(64 << 20))
    body = struct.pack("<QQQII", 0, 1, 1000, 0, 3) + b"lz4" + struct.pack("<Q", len(bomb)) + bomb
    with pytest.raises(DataError, match="chunk"):
        unpack(struct.pack("<BQ", 6, len(body)) + body)
