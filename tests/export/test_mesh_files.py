import json
import struct

import numpy as np
import pytest
from plyfile import PlyData

from mapper.core.errors import DataError
from mapper.export.mesh_files import MESH_WRITERS, write_mesh, write_ply

# One tetrahedron with a black, a grey, a red and a white corner.
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
COLORS = np.array([[0, 0, 0], [128, 128, 128], [255, 0, 0], [255, 255, 255]], np.uint8)
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def glb_parts(path):
    """Parse by the container's rules: 12 bytes of header, then chunks whose lengths are multiples of 4."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    json_length, json_kind = struct.unpack_from("<I4s", data, 12)
    bin_length, bin_kind = struct.unpack_from("<I4s", data, 20 + json_length)
    assert (json_kind, bin_kind) == (b"JSON", b"BIN\0")
    assert json_length % 4 == bin_length % 4 == 0
    assert 28 + json_length + bin_length == length
    return json.loads(data[20 : 20 + json_length]), data[28 + json_length :]


def accessor_values(content, payload, index):
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    dtype = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[accessor["componentType"]]
    columns = {"VEC3": 3, "VEC4": 4, "SCALAR": 1}[accessor["type"]]
    part = payload[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    values = np.frombuffer(part, dtype).reshape(-1, columns)
    assert len(values) == accessor["count"]
    return values


def test_glb_stands_upright_and_keeps_its_colours(tmp_path):
    write_mesh(tmp_path / "a.glb", POINTS, COLORS, TRIANGLES)
    content, payload = glb_parts(tmp_path / "a.glb")
    primitive = content["meshes"][0]["primitives"][0]

    positions = accessor_values(content, payload, primitive["attributes"]["POSITION"])
    np.testing.assert_array_equal(positions, np.array([[0, 0, 0], [1, 0, 0], [0, 0, -2], [0, 3, 0]]))
    assert content["accessors"][0]["min"] == [0, 0, -2]
    assert content["accessors"][0]["max"] == [1, 3, 0]
    np.testing.assert_array_equal(
        accessor_values(content, payload, primitive["indices"]).reshape(-1, 3), TRIANGLES
    )
    rgba = accessor_values(content, payload, primitive["attributes"]["COLOR_0"]) / 65535.0
    grey = 0.2158605  # of sRGB's 128, as IEC 61966-2-1 tabulates it
    np.testing.assert_allclose(
        rgba, [[0, 0, 0, 1], [grey, grey, grey, 1], [1, 0, 0, 1], [1, 1, 1, 1]], atol=1e-5
    )


def test_obj_counts_from_one(tmp_path):
    write_mesh(tmp_path / "a.obj", POINTS, COLORS, TRIANGLES)
    lines = [line.split() for line in (tmp_path / "a.obj").read_text().splitlines() if line[0] != "#"]

    rows = np.array([line[1:] for line in lines if line[0] == "v"], float)
    np.testing.assert_array_equal(rows[:, :3], POINTS)
    np.testing.assert_allclose(rows[:, 3:] * 255.0, COLORS, atol=0.02)
    assert [[int(word) - 1 for word in line[1:]] for line in lines if line[0] == "f"] == TRIANGLES.tolist()


@pytest.mark.parametrize("ending", MESH_WRITERS)
def test_endings_may_be_loud_and_files_are_whole(tmp_path, ending):
    write_mesh(tmp_path / f"a{ending}", POINTS, COLORS, TRIANGLES)
    write_mesh(tmp_path / f"B{ending.upper()}", POINTS, COLORS, TRIANGLES)
    assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"B{ending.upper()}").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


def test_what_is_written_reads_back(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(100, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (100, 3), dtype=np.uint8)
    write_ply(tmp_path / "cloud.ply", points, colors)

    vertices = PlyData.read(tmp_path / "cloud.ply")["vertex"]

    np.testing.assert_array_equal(np.column_stack([vertices[name] for name in "xyz"]), points)
    np.testing.assert_array_equal(
        np.column_stack([vertices[name] for name in ("red", "green", "blue")]), colors
    )
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


def test_an_empty_cloud_is_a_valid_file(tmp_path):
    write_ply(tmp_path / "empty.ply", np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))
    assert len(PlyData.read(tmp_path / "empty.ply")["vertex"].data) == 0


def test_refuses_unequal_shapes_and_leaves_nothing(tmp_path):
    with pytest.raises(DataError, match=r"\(4, 3\)"):
        write_ply(tmp_path / "cloud.ply", np.zeros((5, 3), np.float32), np.zeros((4, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
