"""Cloud files that announce more than they hold are refused before room is made for it."""

import struct
import subprocess
import sys

import laspy
import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud

from mapper.core.errors import FrameError
from mapper.sources import cloud_files
from mapper.sources.cloud_files import read_cloud
from mapper.sources.cloud_files.parsing import refusing_damage

POINTS = np.random.default_rng(0).uniform(-20.0, 20.0, (500, 3))


AGAIN = np.tile(POINTS[:50], (10, 1)).astype(np.float32)
"""Points that can be compressed: pypcd4 stores others as they are."""


def laz(path, *, chunks=None, place=None):
    """Write a LAZ file, and let it announce so many chunks, or its table of them in another place."""
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = np.full(3, 1e-3)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = POINTS.T
    cloud.write(path)
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    if chunks is not None:
        struct.pack_into("<I", data, table + 4, chunks)
    if place is not None:
        struct.pack_into("<q", data, start, place(table, len(data)))
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("chunks", [501, 1 << 20, 1 << 31, (1 << 32) - 1])
def test_a_laz_table_of_more_chunks_than_points_does_not_end_the_process(tmp_path, chunks):
    path = laz(tmp_path / "1.laz", chunks=chunks)
    code = (
        "import resource, sys; from pathlib import Path; from mapper.sources.cloud_files import read_cloud\n"
        "resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))\n"
        "read_cloud(Path(sys.argv[1]))"
    )
    run = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert (
        f"FrameError: {path}: not a sound LAS file: a table of {chunks} chunks for 500 points" in run.stderr
    )


@pytest.mark.parametrize("place", [0, -2, 1 << 62, 332], ids=str)
def test_a_laz_table_outside_of_the_file_is_refused(tmp_path, place):
    path = laz(tmp_path / "1.laz", place=lambda _table, _size: place)
    with pytest.raises(FrameError, match=rf"its chunk table is said to lie at byte {place} of \d+"):
        read_cloud(path)


def test_a_laz_table_whose_place_the_end_of_the_file_tells_is_found(tmp_path):
    path = laz(tmp_path / "1.laz")
    data = path.read_bytes()
    (start,) = struct.unpack_from("<I", data, 96)
    table = data[start : start + 8]
    path.write_bytes(data[:start] + struct.pack("<q", -1) + data[start + 8 :] + table)
    np.testing.assert_allclose(read_cloud(path).points, POINTS, atol=1e-3)


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
