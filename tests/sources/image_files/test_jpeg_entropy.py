import io
from contextlib import suppress
from itertools import product

import cv2
import numpy as np
import pytest
import simplejpeg
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from mapper.core.errors import DataError, FrameError
from mapper.sources import open_source
from mapper.sources.image_files import jpeg
from mapper.sources.image_files.jpeg_entropy import STANDARD_TABLES, check_entropy
from tests.support.jpeg_writing import (
    SIXTEEN_ZEROS,
    coder,
    jpeg_file,
    scan,
    standard_tables,
    stuffed,
)
from tests.support.tum_logs import picture

SAMPLINGS = [
    getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{name}") for name in ("411", "420", "422", "440", "444")
]
LUMINANCE, CHROMINANCE = coder(0), coder(1)
FLAT = LUMINANCE.block(0)


def content(kind, shape, seed=0):
    """Return images as hard to encode as there are: they use every code, and reach every limit."""
    rng = np.random.default_rng(seed)
    height, width = shape[:2]
    y, x = np.mgrid[:height, :width]
    match kind:
        case "noise":
            return rng.integers(0, 256, shape, np.uint8)
        case "black and white":
            return rng.choice(np.array([0, 255], np.uint8), shape)
        case "black":
            return np.zeros(shape, np.uint8)
        case "white":
            return np.full(shape, 255, np.uint8)
        case "chequered":
            tiles = np.uint8(255) * ((y // 8 + x // 8) % 2 == 0)
        case "waves":  # the signs of a basis function: its coefficient is the largest
            tiles = np.uint8(255) * (np.cos((2 * (y % 8) + 1) * 5 * np.pi / 16) * np.cos((x % 8) * 1.1) > 0)
        case "smooth":
            tiles = (3 * x + 2 * y).astype(np.uint8)
    return np.broadcast_to(tiles.reshape(height, width, *[1] * (len(shape) - 2)), shape).astype(np.uint8)


CONTENTS = ("noise", "black and white", "black", "white", "chequered", "waves", "smooth")


def passes(data):
    check_entropy(data)
    return True


@pytest.mark.parametrize("quality", [*range(5, 100, 10), 99, 100])
@pytest.mark.parametrize("kind", CONTENTS)
def test_opencvs_jpegs_pass(kind, quality):
    for channels, optimised, interval in product(((), (3,)), (0, 1), (0, 1, 3)):
        for sampling in SAMPLINGS if channels else SAMPLINGS[:1]:
            options = [
                *(cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, optimised),
                *(cv2.IMWRITE_JPEG_RST_INTERVAL, interval),
                *([cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling] if channels else []),
            ]
            data = cv2.imencode(".jpg", content(kind, (37, 53, *channels)), options)[1].tobytes()
            assert passes(data)


@settings(max_examples=150)
@given(
    st.integers(1, 90),
    st.integers(1, 90),
    st.sampled_from(CONTENTS),
    st.integers(1, 100),
    st.integers(0, 2),
    st.booleans(),
    st.integers(0, 5),
    st.sampled_from(["L", "RGB", "CMYK"]),
)
def test_pillows_jpegs_pass(width, height, kind, quality, subsampling, optimize, interval, mode):
    pixels = content(kind, (height, width) if mode == "L" else (height, width, 3), width)
    file = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(
        file,
        "jpeg",
        quality=quality,
        optimize=optimize,
        subsampling=subsampling,
        restart_marker_blocks=interval,
        bufsize=1 << 20,
    )
    assert passes(file.getvalue())


@pytest.mark.parametrize("kind", CONTENTS)
@pytest.mark.parametrize("sampling", ["444", "422", "420", "440", "411"])
def test_jpegs_of_an_inexact_transform_pass(kind, sampling):
    for quality in range(5, 101, 5):
        pixels = content(kind, (40, 56, 3))
        assert passes(simplejpeg.encode_jpeg(pixels, quality, "RGB", sampling, fastdct=True))


@pytest.mark.parametrize(
    "trailing", [b"", bytes(500), b"\xff\xd9", b"\xff\xd8\xff\xc0", b"\xff" * 9, b"text"]
)
def test_what_follows_the_end_marker_is_not_read(trailing):
    data = cv2.imencode(".jpg", picture(0)[0])[1].tobytes()
    assert jpeg.decode(data + trailing, colour=True).shape == (48, 64, 3)


def test_the_tables_that_may_be_left_out_are_opencvs():
    ours = {number: bytes([number]) + b"".join(table) for number, table in STANDARD_TABLES.items()}
    assert ours == standard_tables()


RICH = [(0, 5), (3, -1), (15, 0), (2, 1023), (15, 0), (15, 0), (0, -7)]
THREE = [0x22, 0x11, 0x11]
OF_ONE_UNIT = 4 * LUMINANCE.block(3, RICH) + 2 * CHROMINANCE.block(-2, [(1, 1)])
WHOLE = {
    "grey": jpeg_file((8, 8), [0x11], [scan([(1, 0)], stuffed(LUMINANCE.block(-60, RICH)))]),
    "grey, sampled twice": jpeg_file((16, 9), [0x22], [scan([(1, 0)], stuffed(4 * FLAT))]),
    "63 coefficients and no end of block": jpeg_file(
        (8, 8), [0x11], [scan([(1, 0)], stuffed(LUMINANCE.block(0, 63 * [(0, 1)], ends=False)))]
    ),
    "a run up to the last coefficient": jpeg_file(
        (8, 8), [0x11], [scan([(1, 0)], stuffed(LUMINANCE.block(0, 3 * [(15, 0)] + [(14, 1)], ends=False)))]
    ),
    "no tables": jpeg_file(
        (16, 16), THREE, [scan([(1, 0), (2, 0x11), (3, 0x11)], stuffed(OF_ONE_UNIT))], tables=False
    ),
    "extended": jpeg_file(
        (8, 8), [0x11], [scan([(1, 0)], stuffed(LUMINANCE.block(1)))], frame=0xC1, words=True
    ),
    # Of 17 × 9 pixels: 3 × 2 blocks by themselves, though 4 × 2 with others; chrominance 2 × 1.
    "a scan for each component": jpeg_file(
        (17, 9),
        THREE,
        [
            scan([(1, 0)], stuffed(6 * LUMINANCE.block(1, RICH))),
            scan([(2, 0x11)], stuffed(2 * CHROMINANCE.block(9))),
            scan([(3, 0x11)], stuffed(2 * CHROMINANCE.block(9))),
        ],
    ),
    "restarts": jpeg_file(
        (8 * 20, 8),
        [0x11],
        [
            scan(
                [(1, 0)],
                b"".join(
                    stuffed(2 * LUMINANCE.block(60)) + (bytes([0xFF, 0xD0 + i % 8]) if i < 9 else b"")
                    for i in range(10)
                ),
            )
        ],
        interval=2,
    ),
    "fill bytes before a marker": jpeg_file(
        (8, 8), [0x11], [scan([(1, 0)], stuffed(FLAT) + b"\xff\xff\xff")]
    ),
    "zeros before the end": jpeg_file((8, 8), [0x11], [scan([(1, 0)], stuffed(FLAT) + bytes(3))]),
    "the last byte filled with zeros": jpeg_file((8, 8), [0x11], [scan([(1, 0)], stuffed(FLAT, "0"))]),
    "black": jpeg_file((8, 8), [0x11], [scan([(1, 0)], stuffed(LUMINANCE.block(-128)))]),
    "a step too black": jpeg_file((8, 8), [0x11], [scan([(1, 0)], stuffed(LUMINANCE.block(-129)))]),
    "a step of 0": jpeg_file((8, 8), [0x11], [scan([(1, 0)], stuffed(FLAT))], step=0),
}


@pytest.mark.parametrize("data", WHOLE.values(), ids=WHOLE.keys())
def test_jpegs_of_every_layout_pass(data):
    assert jpeg.decode(data, colour=True).ndim == 3


def test_a_sampling_that_the_decoder_does_not_know_is_read():
    units = stuffed(3 * LUMINANCE.block(1) + 2 * CHROMINANCE.block(1))
    parts = [(1, 0), (2, 0x11), (3, 0x11)]
    check_entropy(jpeg_file((20, 8), [0x31, 0x11, 0x11], [scan(parts, units)]))
    with pytest.raises(DataError, match="its coded data end early, near pixel"):
        check_entropy(jpeg_file((28, 8), [0x31, 0x11, 0x11], [scan(parts, units)]))


def grey(bits, width=8, **options):
    return jpeg_file((width, 8), [0x11], [scan([(1, 0)], bits)], **options)


DAMAGED = {
    # So long a file that most of it is decoded by the fast decoder; the slow one, near the end, warns.
    "a code that is in no table": grey(
        stuffed(LUMINANCE.dc[0] + 16 * "1" + 599 * LUMINANCE.block(0, RICH)), width=8 * 600
    ),
    "a block of more than 64 coefficients": grey(stuffed(LUMINANCE.block(0, 4 * [(15, 1)]))),
    "a block of more than 64 coefficients ": grey(
        stuffed(LUMINANCE.block(0, 60 * [(0, 1)])[:-4] + LUMINANCE.ac[SIXTEEN_ZEROS] + "1010")
    ),
    "a block brighter or darker": grey(stuffed(LUMINANCE.block(-131))),
    "a block brighter or darker ": grey(stuffed(5 * LUMINANCE.block(27)), width=40),
    "coded data are left over": grey(stuffed(FLAT) + b"\x2b\x2b"),
}


@pytest.mark.parametrize(("reason", "data"), DAMAGED.items())
def test_what_no_encoder_writes_is_refused(reason, data):
    simplejpeg.decode_jpeg(data, "GRAY")  # the decoder takes it without a warning
    with pytest.raises(DataError, match=rf"^damaged JPEG: {reason.strip()}"):
        jpeg.decode(data, colour=False)


def test_a_frame_whose_image_is_refused_can_be_skipped(tiny_tum_log):
    source = open_source(tiny_tum_log(3, ending=".jpg"))
    entries = list(source.entries())
    too_dark = scan([(1, 0)], stuffed(LUMINANCE.block(-131) + 47 * FLAT))
    entries[1].files.colour.write_bytes(jpeg_file((64, 48), [0x11], [too_dark]))
    with pytest.raises(
        FrameError, match=r"\.jpg: damaged JPEG: a block brighter or darker .* pixel \(0, 0\)"
    ):
        entries[1].load()
    assert entries[2].load().image.shape == (48, 64, 3)


@pytest.mark.parametrize("progressive", [0, 1])
def test_noise_in_a_scan_is_refused_but_a_progressive_one_is_the_decoders(progressive):
    rgb, _ = picture(0)
    data = cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    at = data.rindex(b"\xff\xda") + 30
    noise = np.random.default_rng(0).integers(0, 255, 100, np.uint8).tobytes()  # no marker
    harmed = data[:at] + noise + data[at + len(noise) :]
    if progressive:
        check_entropy(harmed)
    else:
        with pytest.raises(DataError):
            check_entropy(harmed)


@pytest.mark.parametrize(
    "data",
    [
        WHOLE["grey"].replace(b"\xff\xda\x00", b"\xff\xda\xff"),
        b"\xff\xd8" + scan([], b"no component, no frame") + WHOLE["grey"][2:],
    ],
    ids=["a scan's header longer than the file", "a scan of nothing"],
)
def test_impossible_headers_are_the_decoders(data):
    check_entropy(data)
    with pytest.raises(DataError, match="JPEG"):
        jpeg.decode(data, colour=True)


@settings(max_examples=300)
@given(st.data())
def test_damaged_headers_are_refused_or_taken(data):
    whole = bytearray(WHOLE[data.draw(st.sampled_from(sorted(WHOLE)))])
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(2, len(whole) - 1))] = data.draw(st.integers(0, 255))
    for check in (check_entropy, lambda file: jpeg.decode(file, colour=True)):
        with suppress(DataError):
            check(bytes(whole))
