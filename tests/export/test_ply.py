import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.export.mesh_files import write_ply


def read_ply(path):
    """Parse by the header alone, as a viewer does."""
    data = path.read_bytes()
    header, _, payload = data.partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    types = {"float": "<f4", "uchar": "u1"}
    fields = [(words[2], types[words[1]]) for words in map(str.split, lines) if words[0] == "property"]
    count = next(int(words[2]) for words in map(str.split, lines) if words[:2] == ["element", "vertex"])
    dtype = np.dtype(fields)
    assert len(payload) == count * dtype.itemsize
    return np.frombuffer(payload, dtype)


def test_what_is_written_reads_back(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(100, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (100, 3), dtype=np.uint8)
    write_ply(tmp_path / "cloud.ply", points, colors)

    vertices = read_ply(tmp_path / "cloud.ply")

    np.testing.assert_array_equal(np.column_stack([vertices[name] for name in "xyz"]), points)
    np.testing.assert_array_equal(
        np.column_stack([vertices[name] for name in ("red", "green", "blue")]), colors
    )
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


def test_an_empty_cloud_is_a_valid_file(tmp_path):
    write_ply(tmp_path / "empty.ply", np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))
    assert len(read_ply(tmp_path / "empty.ply")) == 0


def test_refuses_unequal_shapes_and_leaves_nothing(tmp_path):
    with pytest.raises(DataError, match=r"\(4, 3\)"):
        write_ply(tmp_path / "cloud.ply", np.zeros((5, 3), np.float32), np.zeros((4, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
