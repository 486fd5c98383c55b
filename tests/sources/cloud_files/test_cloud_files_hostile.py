"""Cloud files that announce more than they hold are refused before room is made for it."""

import struct

import laspy
import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud

from mapper.core.errors import FrameError
from mapper.sources import cloud_files
from mapper.sources.cloud_files import read_cloud, why_no_points
from mapper.sources.cloud_files.las import read_las
from mapper.sources.cloud_files.parsing import refusing_damage

POINTS = np.random.default_rng(0).uniform(-20.0, 20.0, (500, 3))
AGAIN = np.tile(POINTS[:50], (10, 1)).astype(np.float32)
"""Points that can be compressed: pypcd4 stores others as they are."""


def laz(path, *, point_format=3):
    header = laspy.LasHeader(point_format=point_format)
    header.scales = np.full(3, 1e-3)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = POINTS.T
    cloud.write(path)
    return path


def with_chunks(path, chunks):
    """Let the table of chunks announce so many."""
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    struct.pack_into("<I", data, table + 4, chunks)
    path.write_bytes(data)


def with_layer(path, layer_bytes):
    """Let the first layer have so many bytes; their sizes follow a point of 36 bytes and a count."""
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    struct.pack_into("<I", data, start + 8 + 36 + 4, layer_bytes)
    path.write_bytes(data)


@pytest.mark.parametrize("point_format", [3, 7])
def test_laz_is_read_as_las(tmp_path, point_format):
    path = laz(tmp_path / "1.laz", point_format=point_format)
    np.testing.assert_allclose(read_cloud(path).points, POINTS, atol=1e-3)
    assert read_las(path).keys() == read_las(laz(tmp_path / "1.las", point_format=point_format)).keys()


@pytest.mark.parametrize(("damage", "point_format"), [(with_chunks, 3), (with_layer, 7)])
@pytest.mark.parametrize("count", [1 << 31, (1 << 32) - 1])
def test_what_makes_lazrs_abort_costs_one_file(tmp_path, capfd, damage, point_format, count):
    sound, damaged = laz(tmp_path / "1.laz"), laz(tmp_path / "2.laz", point_format=point_format)
    damage(damaged, count)
    killed = rf"{damaged}: not a sound LAS file: the process that reads it was killed by SIGABRT"
    with pytest.raises(FrameError, match=killed):
        read_cloud(damaged)
    assert capfd.readouterr() == ("", "")
    np.testing.assert_allclose(read_cloud(sound).points, POINTS, atol=1e-3)


class PanicException(BaseException):
    """What an error in a library written in Rust becomes."""


def test_an_error_within_rust_is_one_about_the_file(tmp_path):
    path = tmp_path / "1.laz"
    refused = pytest.raises(FrameError, match=r"1\.laz: not a sound LAS file: chunk size must be non-zero")
    with refused, refusing_damage(path, what="LAS"):
        raise PanicException("chunk size must be non-zero")
    with pytest.raises(KeyboardInterrupt), refusing_damage(path, what="LAS"):
        raise KeyboardInterrupt


def test_a_laz_file_of_more_points_than_its_bytes_can_hold_is_refused(tmp_path):
    path = laz(tmp_path / "1.laz")
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 107, 4_000_000)
    path.write_bytes(data)
    with pytest.raises(FrameError, match=r"\d+ bytes, but the header says 4000000 points"):
        read_cloud(path)


@pytest.mark.parametrize("encoding", [Encoding.BINARY, Encoding.BINARY_COMPRESSED])
@pytest.mark.parametrize("count", [501, 999_999_999, 10**15])
def test_a_pcd_of_more_points_than_it_has_bytes_is_refused(tmp_path, encoding, count):
    path = tmp_path / "1.pcd"
    PointCloud.from_xyz_points(AGAIN).save(path, encoding)
    path.write_bytes(path.read_bytes().replace(b"500", str(count).encode()))
    with pytest.raises(FrameError, match=rf"the header says {count} points of {12 * count} bytes; was"):
        read_cloud(path)


def test_a_pcd_that_unpacks_to_more_than_lzf_can_is_refused(tmp_path):
    path = tmp_path / "1.pcd"
    PointCloud.from_xyz_points(AGAIN).save(path, Encoding.BINARY_COMPRESSED)
    data = path.read_bytes()
    at = data.index(b"\n", data.index(b"DATA ")) + 1
    sizes = struct.pack("<II", struct.unpack_from("<I", data, at)[0], 12 * 99_999_999)
    path.write_bytes(data[:at].replace(b"500", b"99999999") + sizes + data[at + 8 :])
    with pytest.raises(FrameError, match=r"bytes that unpack to 1199999988, which they cannot or must not"):
        read_cloud(path)


@pytest.mark.parametrize("begin", ["", "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\n"])
def test_a_pcd_without_a_header_is_refused_in_words_of_its_lines(tmp_path, begin):
    path = tmp_path / "1.pcd"
    path.write_text(begin)
    with pytest.raises(FrameError, match=r"size: .*was it cut") as caught:
        read_cloud(path)
    assert "pydantic" not in str(caught.value)


def test_a_pcd_of_countless_values_a_point_is_refused(tmp_path):
    path = tmp_path / "1.pcd"
    PointCloud.from_xyz_points(POINTS.astype(np.float32)).save(path)
    path.write_bytes(path.read_bytes().replace(b"COUNT 1 1 1", b"COUNT 1 1 999999999"))
    with pytest.raises(FrameError, match=r"1000000001 values a point, want 10000 at most"):
        read_cloud(path)


def test_a_file_beyond_the_limit_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "1.npy"
    np.save(path, POINTS)
    assert len(read_cloud(path).points) == 500
    monkeypatch.setattr(cloud_files, "MOST_BYTES", 1000)
    with pytest.raises(FrameError, match=rf"{path}: 12128 bytes, want 1000 at most; split it"):
        read_cloud(path)


def test_a_text_file_of_lines_of_several_lengths_is_no_cloud(tmp_path):
    path = tmp_path / "1.csv"
    path.write_text("1.5,2,3\n4,5\n" + 10 * "6,7,8\n")
    assert why_no_points(path) == "'4 5' is not three or more numbers"
