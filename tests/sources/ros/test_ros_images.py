import struct
from dataclasses import replace
from itertools import groupby

import cv2
import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.sources.ros.image_messages import (
    depth_file_of,
    depth_m_of,
    has_float_depth,
    image_of,
    is_depth,
    size_of,
)
from mapper.sources.ros.messages import FileMessage, PixelsMessage
from tests.support.tum_logs import picture

RGB, UNITS = picture(3)
GREY = cv2.cvtColor(RGB, cv2.COLOR_RGB2GRAY)


def pixels(array, encoding, *, padding=0, is_big_endian=False):
    """An image message whose rows end in padding."""
    height, width = array.shape[:2]
    rows = np.ascontiguousarray(array).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return PixelsMessage(
        0, "optical", encoding, width, height, rows.shape[1], is_big_endian, memoryview(rows.tobytes())
    )


def file(data, format_):
    return FileMessage(0, "optical", format_, memoryview(bytes(data)))


def encoded(array, ending):
    return cv2.imencode(ending, array)[1].tobytes()


def rvl(units):
    """RVL as its paper's code writes it: counts and differences in nibbles of three bits, eight to a word."""
    nibbles, before, values = [], 0, units.ravel().tolist()

    def write(number):
        while number > 7:
            nibbles.append(number & 7 | 8)
            number >>= 3
        nibbles.append(number)

    for is_measured, run in groupby([0, *values] if values[0] else values, key=bool):
        measured = list(run)
        write(0 if values[0] and not is_measured and not nibbles else len(measured))
        for value in measured if is_measured else ():
            write(2 * (value - before) if value >= before else 2 * (before - value) - 1)
            before = value
    if not values[-1]:
        write(0)
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{nibble:x}" for nibble in word), 16) for word in np.reshape(nibbles, (-1, 8))]
    return struct.pack("<II", *units.shape[::-1]) + struct.pack(f"<{len(words)}I", *words)


ALPHA = np.full((*RGB.shape[:2], 1), 255, np.uint8)
BGR = RGB[:, :, ::-1]


@pytest.mark.parametrize("padding", [0, 13])
@pytest.mark.parametrize(
    ("encoding", "array"),
    [
        ("rgb8", RGB),
        ("bgr8", BGR),
        ("8UC3", BGR),
        ("rgba8", np.concatenate([RGB, ALPHA], axis=2)),
        ("bgra8", np.concatenate([BGR, ALPHA], axis=2)),
        ("8UC4", np.concatenate([BGR, ALPHA], axis=2)),
        ("rgb16", RGB.astype(np.uint16) * 257),
        ("bgr16", BGR.astype(np.uint16) * 257),
        ("16UC4", np.concatenate([BGR, ALPHA], axis=2).astype(np.uint16) * 257),
    ],
)
def test_colour_comes_as_rgb_and_as_the_grey_of_files(encoding, array, padding):
    message = pixels(array, encoding, padding=padding)
    np.testing.assert_array_equal(image_of(message, colour=True, where="m"), RGB)
    np.testing.assert_array_equal(image_of(message, colour=False, where="m"), GREY)
    assert not is_depth(message)
    assert size_of(message, where="m") == (64, 48)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_stays_grey(encoding):
    for colour in (True, False):
        np.testing.assert_array_equal(image_of(pixels(GREY, encoding), colour=colour, where="m"), GREY)


@pytest.mark.parametrize("encoding", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_named_by_their_first_pixels(encoding):
    """A plain red image is red, whichever pattern it was taken through."""
    mosaic = np.zeros((48, 64), np.uint8)
    at = encoding.index("r")
    mosaic[at // 2 :: 2, at % 2 :: 2] = 200
    image = image_of(pixels(mosaic, f"bayer_{encoding}8"), colour=True, where="m")
    np.testing.assert_array_equal(image[8:-8, 8:-8].reshape(-1, 3).max(axis=0), [200, 0, 0])


def test_yuv_is_read_in_both_orders_of_bytes():
    yuyv = np.zeros((48, 64, 2), np.uint8)
    yuyv[:, :, 0], yuyv[:, :, 1] = 126, 128
    for message in (
        *(pixels(yuyv, name) for name in ("yuv422_yuy2", "yuyv")),
        *(pixels(yuyv[:, :, ::-1], name) for name in ("yuv422", "uyvy")),
    ):
        image = image_of(message, colour=True, where="m")
        assert np.abs(image.astype(int) - 128).max() <= 1
        assert image_of(message, colour=False, where="m").shape == (48, 64)


@pytest.mark.parametrize("padding", [0, 16])
@pytest.mark.parametrize(("encoding", "u_first"), [("nv12", True), ("nv21", False)])
def test_half_size_planes_of_colour_follow_the_grey_one(encoding, u_first, padding):
    """By BT.601, U 90 and V 240 on Y 81 are red."""
    rows = np.full((48 * 3 // 2, 64), 81, np.uint8)
    rows[48:, 0::2], rows[48:, 1::2] = (90, 240) if u_first else (240, 90)
    message = replace(pixels(rows, encoding, padding=padding), height_px=48)
    assert size_of(message, where="m") == (64, 48)
    assert np.abs(image_of(message, colour=True, where="m").astype(int) - [255, 0, 0]).max() <= 2
    np.testing.assert_array_equal(image_of(message, colour=False, where="m"), rows[:48])


def test_bytes_of_16_bits_are_in_the_order_that_the_message_says():
    values = (RGB.astype(np.uint16) * 256 + 7).astype(">u2")
    message = pixels(values, "rgb16", is_big_endian=True)
    np.testing.assert_array_equal(image_of(message, colour=True, where="m"), RGB)


@pytest.mark.parametrize(("ending", "format_"), [(".png", "png"), (".jpg", "rgb8; jpeg compressed bgr8")])
def test_image_files_are_decoded_as_on_disk(ending, format_):
    data = encoded(BGR, ending)
    message = file(data, format_)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(image_of(message, colour=True, where="m"), expected)
    assert size_of(message, where="m") == (64, 48)
    assert not is_depth(message)


HEADER = struct.pack("<iff", 0, 0.0, 0.0)
METRES = np.linspace(0.5, 4.0, 48 * 64, dtype=np.float32).reshape(48, 64)
MILLIMETRES_M = UNITS.astype(np.float32) / np.float32(1000)
"""UNITS as depth."""


def spoilt(array, values, *, kind):
    """Overwrite the first pixels with what is no depth."""
    stored = array.astype(kind)
    stored[0, : len(values)] = values
    return stored


def holed(depth_m, pixels):
    depth_m = depth_m.copy()
    depth_m[0, :pixels] = 0.0
    return depth_m


SATURATED = holed(MILLIMETRES_M, 1)
WILD = [np.nan, np.inf, -np.inf, -1.0, 65504.0]
HALF = (UNITS // 2).astype(np.int16)
HALF_M = holed(HALF.astype(np.float32) / np.float32(1000), 5)


@pytest.mark.parametrize(
    ("message", "depth_m", "is_float"),
    [
        *(
            (
                pixels(spoilt(UNITS, [65535], kind=kind), name, padding=2, is_big_endian=kind == ">u2"),
                SATURATED,
                False,
            )
            for name in ("16UC1", "mono16")
            for kind in ("<u2", ">u2")
        ),
        (pixels(spoilt(HALF, [-1] * 5, kind="<i2"), "16SC1"), HALF_M, False),
        (pixels(METRES.astype(np.float64), "64FC1"), METRES, True),
        *(
            (
                pixels(spoilt(METRES, WILD, kind=kind), "32FC1", is_big_endian=kind == ">f4"),
                holed(METRES, 5),
                True,
            )
            for kind in ("<f4", ">f4")
        ),
        (file(HEADER + encoded(UNITS, ".png"), "16UC1; compressedDepth png"), MILLIMETRES_M, False),
        (file(encoded(UNITS, ".png"), "16UC1; png compressed "), MILLIMETRES_M, False),
        # Known by their bytes, whatever the format says:
        (file(HEADER + encoded(UNITS, ".png"), "png"), MILLIMETRES_M, False),
        (file(HEADER + encoded(UNITS, ".png"), ""), MILLIMETRES_M, False),
        (file(encoded(UNITS, ".png"), "16UC1; compressedDepth png"), MILLIMETRES_M, False),
        (file(encoded(UNITS, ".png"), "jpeg"), MILLIMETRES_M, False),
        (file(encoded(UNITS, ".tiff"), "16UC1; tiff"), MILLIMETRES_M, False),
        (file(encoded(METRES, ".tiff"), "tiff"), METRES, True),
    ],
)
def test_depth_is_millimetres_or_floats_of_metres_and_0_where_it_is_none(message, depth_m, is_float):
    assert is_depth(message)
    assert has_float_depth(message) == is_float
    got = depth_m_of(message, units_per_m=1000.0, where="m")
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, depth_m)
    kept = depth_file_of(message)
    assert kept is None or kept == encoded(UNITS, ".png")


def test_compressed_depth_of_32_bits_is_inverse_depth():
    """As compressed_depth_image_transport writes it: A = q · (q + 1) and B = 1 − A / max depth, q = 100."""
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    depth = np.linspace(0.5, 9.0, 48 * 64, dtype=np.float64).reshape(48, 64)
    stored = np.rint(a / depth + b).astype(np.uint16)
    stored[0, 0] = 0
    message = file(struct.pack("<iff", 0, a, b) + encoded(stored, ".png"), "32FC1; compressedDepth png")
    got = depth_m_of(message, units_per_m=1000.0, where="m")
    assert got[0, 0] == 0.0
    np.testing.assert_allclose(got.ravel()[1:], depth.ravel()[1:], rtol=5e-4 * 9.0)


def test_depth_is_in_the_order_of_bytes_that_makes_it_smooth():
    units = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint16) + 900
    for is_big_endian, stored in (
        (True, units),
        (True, units.byteswap()),
        (False, units),
        (False, units.byteswap()),
    ):
        message = pixels(stored, "16UC1", is_big_endian=is_big_endian)
        np.testing.assert_array_equal(depth_m_of(message, units_per_m=1.0, where="m"), units)


def test_what_an_encoding_is_called_is_read_by_its_content():
    for encoding in ("BGR8", "bgr", "bgr24", "8UC3 "):
        np.testing.assert_array_equal(image_of(pixels(BGR, encoding), colour=True, where="m"), RGB)
    np.testing.assert_array_equal(image_of(pixels(GREY, "gray8"), colour=True, where="m"), GREY)
    units = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint16)
    for encoding, kind in (
        ("Z16", np.uint16),
        ("MONO16", np.uint16),
        ("16UC1 ", np.uint16),
        ("32SC1", np.int32),
    ):
        depth = pixels(units.astype(kind), encoding)
        assert is_depth(depth)
        np.testing.assert_array_equal(depth_m_of(depth, units_per_m=1.0, where="m"), units)
    message = replace(pixels(RGB, "mjpeg"), data=memoryview(encoded(BGR, ".png")))
    np.testing.assert_array_equal(image_of(message, colour=True, where="m"), RGB)


def test_rows_that_follow_each_other_are_read_whatever_step_says():
    message = replace(pixels(RGB, "rgb8"), row_bytes=64)
    np.testing.assert_array_equal(image_of(message, colour=True, where="m"), RGB)


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (replace(pixels(RGB, "rgb8"), height_px=0), "px"),
        (replace(pixels(RGB, "rgb8"), data=memoryview(b"")), "but 0 bytes are there"),
        (pixels(RGB, "nv24"), "colour encoded as 'nv24'; known are rgb8"),
        (replace(pixels(GREY[:, :63], "nv12"), height_px=32), "nv12 of 63×32 px, want even numbers"),
        (pixels(GREY, "nv12"), "but 3072 bytes are there"),
        (file(encoded(BGR, ".jpg")[:-50], "jpeg"), "truncated JPEG"),
        (file(b"", "jpeg"), "empty file"),
        (PixelsMessage(0, "", "rgb8", 64, 48, 192, False, memoryview(bytes(100))), "but 100 bytes are there"),
        (PixelsMessage(0, "", "rgb8", 900, 7000, 1, False, memoryview(bytes(9999))), "in rows of 1 bytes"),
    ],
)
def test_what_is_no_image_is_refused(message, why):
    with pytest.raises(FrameError, match=f"m: .*{why}"):
        image_of(message, colour=True, where="m")


NOISE = np.random.default_rng(0).integers(0, 65536, (48, 64)).astype(np.uint16)


@pytest.mark.parametrize("units", [UNITS, np.zeros((48, 64), np.uint16), NOISE, np.maximum(NOISE, 1)])
def test_rvl_has_the_units_of_png(units):
    a, b = 120.0, -3.0
    header = struct.pack("<iff", 0, a, b)
    for kind in ("16UC1", "32FC1"):
        as_png, as_rvl = (
            depth_m_of(file(header + data, f"{kind}; compressedDepth {name}"), units_per_m=1000.0, where="m")
            for name, data in (("png", encoded(units, ".png")), ("rvl", rvl(units)))
        )
        np.testing.assert_array_equal(as_png, as_rvl)


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (pixels(RGB, "rgb8"), "depth encoded as rgb8; known are 16UC1"),
        (file(bytes(4), "16UC1; compressedDepth png"), "compressedDepth of 4 bytes"),
        (file(bytes(40), "16UC1; compressedDepth rvl"), "RVL of 0×0 px"),
        (file(bytes(16), "16UC1; compressedDepth rvl"), "RVL of 4 bytes"),
        (file(bytes(12) + rvl(UNITS)[:-40], "16UC1; compressedDepth rvl"), "64×48 px is damaged, from pixel"),
        (file(bytes(12) + rvl(UNITS)[:8] + b"\xff" * 99, "16UC1; compressedDepth rvl"), "from pixel 0 on"),
        (file(bytes(12) + b"\xff" * 99, "16UC1; compressedDepth rvl"), "want 1 to"),
        (file(b"\0\0\0\1\x40" + bytes(40), "h265"), "video is not read"),
        (file(encoded(GREY, ".png"), "16UC1; png"), "want one channel of 16 bits"),
    ],
)
def test_what_is_no_depth_is_refused(message, why):
    with pytest.raises(FrameError, match=f"m: .*{why}"):
        depth_m_of(message, units_per_m=1000.0, where="m")
