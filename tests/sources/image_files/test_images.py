import io
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapper.core.errors import DataError, FrameError
from mapper.sources.image_files import jpeg, png
from mapper.sources.image_files.reading import (
    read_array_m,
    read_colour,
    read_depth_m,
    read_grey,
    valid_depth,
)
from tests.support.tum_logs import picture

FILTERS = {
    "none": cv2.IMWRITE_PNG_FILTER_NONE,
    "sub": cv2.IMWRITE_PNG_FILTER_SUB,
    "up": cv2.IMWRITE_PNG_FILTER_UP,
    "average": cv2.IMWRITE_PNG_FILTER_AVG,
    "paeth": cv2.IMWRITE_PNG_FILTER_PAETH,
    "adaptive": cv2.IMWRITE_PNG_ALL_FILTERS,
}


def encoded(pixels, filters=cv2.IMWRITE_PNG_ALL_FILTERS):
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_FILTER, filters])[1].tobytes()


@pytest.mark.parametrize("filters", FILTERS.values(), ids=FILTERS.keys())
@pytest.mark.parametrize("kind", ["rgb", "depth"])
def test_png_equals_opencv_for_every_row_filter(filters, kind):
    rng = np.random.default_rng(0)
    rgb, depth = picture(3)
    noisy = {
        "rgb": rgb ^ rng.integers(0, 8, rgb.shape, dtype=np.uint8),
        "depth": depth ^ rng.integers(0, 600, depth.shape, dtype=np.uint16),
    }[kind]
    data = encoded(noisy, filters)
    assert png.is_plain(data)
    want = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    got = png.decode(data)
    np.testing.assert_array_equal(got[:, :, ::-1] if kind == "rgb" else got, want)


@settings(max_examples=60)
@given(
    st.one_of(
        arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9))),
        arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))),
    )
)
def test_png_returns_any_pixels_that_went_in(pixels):
    got = png.decode(encoded(pixels))
    np.testing.assert_array_equal(got, pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)
    assert got.dtype == pixels.dtype


@given(st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))
def test_the_branchless_predictor_is_paeths(left, above, corner):
    guess = left + above - corner
    nearest = min((abs(guess - value), order) for order, value in enumerate((left, above, corner)))
    assert png.paeth.py_func(left, above, corner) == (left, above, corner)[nearest[1]]


@pytest.mark.parametrize("cut", [1, 8, 20, 40, 200, 0.5, -13])
def test_a_png_cut_anywhere_is_refused_quietly(tmp_path, capfd, cut):
    data = encoded(picture(0)[1])
    end = int(len(data) * cut) if isinstance(cut, float) else cut
    path = tmp_path / "d.png"
    path.write_bytes(data[:end])
    with pytest.raises(FrameError, match=r"d\.png: "):
        read_depth_m(path, 5000.0)
    assert capfd.readouterr() == ("", "")


def test_one_damaged_byte_of_a_png_is_noticed(tmp_path, capfd):
    data = bytearray(encoded(picture(0)[0]))
    data[len(data) // 2] ^= 0x55
    path = tmp_path / "c.png"
    path.write_bytes(data)
    with pytest.raises(FrameError, match=r"c\.png: damaged PNG"):
        read_colour(path)
    assert capfd.readouterr() == ("", "")


def test_a_png_whose_header_lies_about_the_size_is_refused():
    data = bytearray(encoded(picture(0)[1]))
    data[16:20] = (65).to_bytes(4, "big")
    with pytest.raises(DataError, match="bytes of pixels, want"):
        png.decode(bytes(data))


def test_an_unknown_row_filter_is_refused():
    data = encoded(np.zeros((2, 2), np.uint16))
    stream = zlib.compress(bytes([9, 0, 0, 0, 0, 0, 0, 0, 0, 0]))
    chunk = len(stream).to_bytes(4, "big") + b"IDAT" + stream + bytes(4)
    with pytest.raises(DataError, match="unknown filter"):
        png.decode(data[:33] + chunk + data[-12:])


@pytest.mark.parametrize("keep", [0.3, 0.9, 0.999])
def test_a_cut_jpeg_is_refused_quietly(tmp_path, capfd, keep):
    data = cv2.imencode(".jpg", picture(0)[0])[1].tobytes()
    path = tmp_path / "c.jpg"
    path.write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(FrameError, match=r"c\.jpg: truncated JPEG"):
        read_grey(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "options", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]]
)
@pytest.mark.parametrize("grey", [False, True])
def test_jpeg_equals_opencv(options, grey):
    rgb, _ = picture(3, width_px=80, height_px=60)
    pixels = rgb[:, :, 0] if grey else rgb[:, :, ::-1]
    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 90, *options])[1]
    for colour, flags in ((True, cv2.IMREAD_COLOR_RGB), (False, cv2.IMREAD_GRAYSCALE)):
        np.testing.assert_array_equal(jpeg.decode(data.tobytes(), colour=colour), cv2.imdecode(data, flags))


def damaged(data, how, rng):
    """Damage the scan of a JPEG, of which its second half is a part, in one way."""
    at = int(rng.integers(len(data) // 2, len(data) - 1000))
    match how:
        case "cut, and ended":
            return data[:at] + b"\xff\xd9"
        case "overwritten":
            return data[:at] + rng.bytes(1000) + data[at + 1000 :]
        case "repeated":
            return data[:at] + data[at - 1000 :]
        case "left out":
            return data[: at - 1000] + data[at:]


@pytest.mark.parametrize("how", ["cut, and ended", "overwritten", "repeated", "left out"])
def test_a_damaged_jpeg_is_refused_quietly(tmp_path, capfd, how):
    rgb, _ = picture(0, width_px=320, height_px=240)
    data = cv2.imencode(".jpg", rgb)[1].tobytes()
    path = tmp_path / "c.jpg"
    rng = np.random.default_rng(0)
    reasons = []
    for _ in range(50):
        path.write_bytes(damaged(data, how, rng))
        try:
            read_colour(path)
        except FrameError as error:
            reasons.append(str(error))
    assert (
        len(reasons) >= 48
    )  # rarely as many blocks follow as before, and nothing shows that they are others
    assert all("c.jpg: damaged JPEG: " in reason for reason in reasons)
    assert capfd.readouterr() == ("", "")


def test_a_jpeg_of_countless_scans_is_refused(tmp_path):
    data = cv2.imencode(".jpg", picture(0)[0], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    scan = data.rindex(b"\xff\xda")
    path = tmp_path / "c.jpg"
    path.write_bytes(data[:-2] + 10_000 * data[scan:-2] + data[-2:])
    with pytest.raises(FrameError, match=r"c\.jpg: damaged JPEG: 10\d\d\d scans, want 500 at most"):
        read_grey(path)


def test_a_jpeg_followed_by_padding_is_whole(tmp_path):
    data = cv2.imencode(".jpg", picture(0)[0])[1].tobytes()
    path = tmp_path / "c.jpg"
    path.write_bytes(data + bytes(500))
    assert read_colour(path).shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "cannot be read: No such file"), (b"", "empty file"), (b"GIF89 no image at all", "not an image")],
)
def test_what_is_no_image_is_named(tmp_path, content, message):
    path = tmp_path / "x.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FrameError, match=rf"x\.png: {message}"):
        read_colour(path)


def test_depth_is_metres_and_neither_zero_nor_saturation_is_a_measurement(tmp_path):
    path = tmp_path / "d.png"
    path.write_bytes(encoded(np.array([[0, 1, 5000], [65535, 65534, 12345]], np.uint16)))
    depth_m = read_depth_m(path, 5000.0)
    assert depth_m.dtype == np.float32
    want = np.array([[0, 0.0002, 1], [0, 65534 / 5000, 2.469]], np.float32)
    np.testing.assert_array_equal(depth_m, want)


def test_a_colour_image_is_no_depth_and_a_depth_image_no_colour(tmp_path):
    rgb, units = picture(0)
    (tmp_path / "c.png").write_bytes(encoded(rgb))
    (tmp_path / "d.png").write_bytes(encoded(units))
    with pytest.raises(FrameError, match=r"c\.png: depth image of uint8 \(48, 64, 3\)"):
        read_depth_m(tmp_path / "c.png", 5000.0)
    for read in (read_colour, read_grey):
        with pytest.raises(FrameError, match=r"d\.png: colour image of uint16"):
            read(tmp_path / "d.png")


def test_colour_is_rgb_whatever_the_file_holds(tmp_path):
    rgb, _ = picture(0)
    variants = {
        "plain": rgb[:, :, ::-1],
        "alpha": np.dstack([rgb[:, :, ::-1], np.full(rgb.shape[:2], 255, np.uint8)]),
    }
    for name, pixels in variants.items():
        path = tmp_path / f"{name}.png"
        path.write_bytes(encoded(pixels))
        np.testing.assert_array_equal(read_colour(path), rgb)
        # OpenCV's reader and its colour conversion round luminance differently.
        np.testing.assert_allclose(read_grey(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), atol=1)
    grey = rgb[:, :, 0]
    (tmp_path / "grey.png").write_bytes(encoded(grey))
    np.testing.assert_array_equal(read_grey(tmp_path / "grey.png"), grey)
    np.testing.assert_array_equal(read_colour(tmp_path / "grey.png"), np.dstack([grey] * 3))


def test_a_palette_png_falls_back_to_opencv(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow writes the palette")
    rgb, _ = picture(2)
    buffer = io.BytesIO()
    image.fromarray(rgb).quantize(16).save(buffer, "png")
    assert not png.is_plain(buffer.getvalue())
    path = tmp_path / "p.png"
    path.write_bytes(buffer.getvalue())
    assert read_colour(path).shape == rgb.shape


@pytest.mark.filterwarnings("error")
def test_numbers_that_are_no_depth_are_0_in_an_array(tmp_path):
    signalling = np.array([0x7FA00000], np.uint32).view(np.float32)[0]
    for kind, strange in ((np.float32, [signalling, np.inf, -1.0]), (np.float64, [1e300, np.nan, -1.0])):
        np.save(tmp_path / "d.npy", np.array([[*strange, 2.0]], kind))
        for depth_m in (
            read_array_m(tmp_path / "d.npy", 1000.0, 1.0),
            valid_depth(np.load(tmp_path / "d.npy"), 1.0, where="a message"),
        ):
            np.testing.assert_array_equal(depth_m, [[0.0, 0.0, 0.0, 2.0]])
