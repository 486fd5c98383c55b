"""An image is decoded only if its header announces no more pixels than a camera has."""

import struct
import tracemalloc
import zlib
from contextlib import suppress

import cv2
import numpy as np
import pytest

from mapper.core.errors import DataError, FrameError
from mapper.sources.image_files.reading import decode_colour, decode_depth_units, decode_grey
from mapper.sources.image_files.size import MOST_MEGAPIXELS, size_of

DECODERS = {
    "colour": lambda data: decode_colour(data, "x"),
    "grey": lambda data: decode_grey(data, "x"),
    "depth": lambda data: decode_depth_units(data, "x"),
}


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I4s", len(body), kind) + body + struct.pack(">I", zlib.crc32(kind + body))


def png_of(width: int, height: int, pixels: bytes, *, bits: int = 16, colour_type: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0)
    chunks = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(pixels)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def with_size(data: bytes, old: tuple[int, int], new: tuple[int, int], layout: str) -> bytes:
    """Let the header of a file announce another size."""
    before, after = struct.pack(layout, *old), struct.pack(layout, *new)
    assert before in data
    return data.replace(before, after, 1)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".tiff", ".ppm"])
def test_sizes_are_those_that_opencv_decodes(ending):
    data = cv2.imencode(ending, np.zeros((7, 13, 3), np.uint8))[1].tobytes()
    assert size_of(data) == (13, 7)
    assert decode_colour(data, "x").shape == (7, 13, 3)


def test_a_comment_in_a_pgm_is_no_size():
    data = b"P5\n# 9 9\n3 # 8\n2\n255\n" + bytes(6)
    assert size_of(data) == (3, 2)
    assert decode_grey(data, "x").shape == (2, 3)


def test_webp_is_read_too():
    assert decode_grey(cv2.imencode(".webp", np.zeros((7, 13, 3), np.uint8))[1].tobytes(), "x").shape == (
        7,
        13,
    )


HUGE = {
    "plain PNG": png_of(65535, 65535, b""),
    "PNG": png_of(65535, 65535, b"", bits=8),
    "JPEG": with_size(
        cv2.imencode(".jpg", np.zeros((7, 13, 3), np.uint8))[1].tobytes(), (7, 13), (65500, 65500), ">HH"
    ),
    "BMP": with_size(
        cv2.imencode(".bmp", np.zeros((7, 13, 3), np.uint8))[1].tobytes(), (13, 7), (40000, -40000), "<ii"
    ),
    "PGM": b"P5\n40000 40000\n255\n",
    "TIFF": b"II*\0\x08\0\0\0\x02\0" + struct.pack("<HHIIHHII", 256, 4, 1, 40000, 257, 3, 1, 40000),
}


@pytest.mark.parametrize("data", HUGE.values(), ids=HUGE.keys())
@pytest.mark.parametrize("decode", DECODERS.values(), ids=DECODERS.keys())
def test_an_image_without_measure_is_not_decoded(decode, data):
    with pytest.raises(Exception, match=rf"x: .* \d+×\d+ px; more than {MOST_MEGAPIXELS} megapixels"):
        decode(data)


@pytest.mark.parametrize("data", HUGE.values(), ids=HUGE.keys())
def test_headers_that_end_are_named(data):
    for end in range(3, len(data)):
        with suppress(DataError):  # and nothing else
            size_of(data[:end])


def test_pixels_beyond_those_announced_are_not_unpacked():
    bomb = png_of(8, 8, bytes(100 << 20))
    tracemalloc.start()
    try:
        with pytest.raises(FrameError, match=r"damaged PNG: 137 bytes of pixels, want 136"):
            decode_depth_units(bomb, "x")
        assert tracemalloc.get_traced_memory()[1] < 4 * len(bomb) + (1 << 20)
    finally:
        tracemalloc.stop()


def test_a_stream_that_ends_without_its_checksum_is_damaged():
    data = png_of(8, 8, bytes(136))
    packed = zlib.compress(bytes(136))
    cut = data.replace(chunk(b"IDAT", packed), chunk(b"IDAT", packed[:-4]))
    with pytest.raises(FrameError, match="damaged PNG: "):
        decode_depth_units(cut, "x")
