import json
import struct
import zlib

import numpy as np
import pytest

from mapper.core.errors import MapFileError, MapSizeError, WriteError
from mapper.core.frames import Scan
from mapper.octree import sparse_grid
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap, read_octree
from mapper.octree.map_file import MAGIC, write_map
from tests.support.octree_maps import attributes_of_leaves

HEADER = len(MAGIC) + 12


def mapped(*, attributes, order=(0, 1, 2)):
    octree = OctreeMap(OctreeConfig(resolution_m=0.1, hit_probability=0.8, attributes=attributes))
    for seed in order:
        rng = np.random.default_rng(seed)
        points = rng.normal(0.0, 1.0, (300, 3)).astype(np.float32)
        octree.insert(
            Scan(seed, points, colors=rng.integers(0, 256, points.shape, dtype=np.uint8)), np.eye(4)
        )
    return octree


@pytest.fixture
def path(tmp_path):
    write_map(tmp_path / "map.octree", mapped(attributes=True))
    return tmp_path / "map.octree"


@pytest.mark.parametrize("attributes", [False, True])
def test_a_map_written_some_blocks_at_a_time_is_the_same(attributes, tmp_path, monkeypatch):
    octree = mapped(attributes=attributes)
    write_map(tmp_path / "at once.octree", octree)
    monkeypatch.setattr("mapper.octree.map_file.BLOCKS_AT_ONCE", 5)
    monkeypatch.setattr("mapper.octree.queries.BLOCKS_AT_ONCE", 5)

    write_map(tmp_path / "map.octree", octree)

    assert len(octree.blocks) > 5
    assert (tmp_path / "map.octree").read_bytes() == (tmp_path / "at once.octree").read_bytes()
    leaves = octree.leaves()
    is_occupied = leaves.log_odds >= octree.occupied_log_odds
    np.testing.assert_array_equal(octree.occupied(), leaves.centres_world[is_occupied])
    np.testing.assert_array_equal(octree.free(), leaves.centres_world[~is_occupied])


@pytest.mark.parametrize("attributes", [False, True])
def test_everything_comes_back(attributes, tmp_path):
    octree = mapped(attributes=attributes)
    write_map(tmp_path / "map.octree", octree)

    again = read_octree(tmp_path / "map.octree")

    assert again.config == octree.config
    assert len(again) == len(octree)
    np.testing.assert_array_equal(again.leaves().keys, octree.leaves().keys)
    np.testing.assert_array_equal(again.leaves().log_odds, octree.leaves().log_odds)
    if attributes:
        found, before = attributes_of_leaves(again), attributes_of_leaves(octree)
        for name in ("colors", "colored", "hits", "last_seen_ns"):
            np.testing.assert_array_equal(getattr(found, name), getattr(before, name))
    else:
        assert again.attributes is None


def test_a_map_that_was_read_goes_on_as_if_it_had_not_been_written(path):
    again, octree = read_octree(path), mapped(attributes=True)
    scan = Scan(9, np.random.default_rng(9).normal(0.0, 1.0, (300, 3)).astype(np.float32))
    for each in (again, octree):
        each.insert(scan, np.eye(4))
    write_map(path.with_name("again.octree"), again)
    write_map(path.with_name("octree.octree"), octree)

    assert path.with_name("again.octree").read_bytes() == path.with_name("octree.octree").read_bytes()


def test_an_empty_map_comes_back(tmp_path):
    write_map(tmp_path / "map.octree", OctreeMap(OctreeConfig(resolution_m=0.2, attributes=True)))

    again = read_octree(tmp_path / "map.octree")

    assert (len(again), again.resolution_m) == (0, 0.2)


def test_another_sensor_model_replaces_the_file_s_but_not_its_resolution(path):
    again = read_octree(path, OctreeConfig(resolution_m=0.5, hit_probability=0.6))

    assert (again.resolution_m, again.config.hit_probability) == (0.1, 0.6)
    assert again.attributes is not None


def test_settings_that_were_dropped_since_the_file_was_written_do_not_matter(path):
    before = read_octree(path)
    dropped = {"dynamic": "none", "seen_through_scans": 3}
    path.write_bytes(resealed(path.read_bytes(), lambda header: header["config"].update(dropped)))

    again = read_octree(path)

    assert again.config == before.config
    assert len(again) == len(before)


def resealed(data, change):
    """The file with its header changed and its checksum right."""
    version, length, _ = struct.unpack_from("<III", data, len(MAGIC))
    header = json.loads(data[HEADER : HEADER + length])
    change(header)
    head = json.dumps(header).encode()
    rest = head + data[HEADER + length :]
    return MAGIC + struct.pack("<III", version, len(head), zlib.crc32(rest)) + rest


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda data: data[: HEADER - 3], "it is truncated"),
        (lambda data: data[:-1], "truncated or damaged"),
        (lambda data: data[:100] + bytes([data[100] ^ 1]) + data[101:], "truncated or damaged"),
        (lambda data: data + b"more", "truncated or damaged"),
        (lambda data: MAGIC + struct.pack("<I", 7) + data[len(MAGIC) + 4 :], "is of version 7, only 1"),
        (lambda data: resealed(data, lambda header: header.pop("config")), "does not describe a map"),
        (lambda data: resealed(data, lambda header: header.update(voxels=-1)), "has counts"),
        (lambda data: resealed(data, lambda header: header.update(voxels=5)), "its body is not the"),
        (lambda data: resealed(data, lambda header: header.update(voxels=1 << 33)), "has counts"),
        (lambda data: resealed(data, lambda header: header.update(attribute_blocks=1 << 20)), "has counts"),
        (lambda data: resealed(data, lambda header: header.update(attribute_voxels=1 << 33)), "has counts"),
        (lambda data: data[2:], "not an OctoMap file"),
    ],
)
def test_damage_is_one_line(path, damage, complaint):
    path.write_bytes(damage(path.read_bytes()))

    with pytest.raises(MapFileError, match=complaint) as caught:
        read_octree(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_everything_that_a_header_announces_has_to_fit_into_memory(path, monkeypatch):
    def announce(header):
        header.update(blocks=1 << 20, voxels=1 << 29, attribute_blocks=0, attribute_voxels=0)

    path.write_bytes(resealed(path.read_bytes(), announce))
    monkeypatch.setattr(sparse_grid.os, "sysconf", lambda _name: 1 << 16)  # of 4 GiB; the blocks alone take 2
    with pytest.raises(MapSizeError, match=r"map\.octree needs 4\.1 GiB and this machine has 4\.0"):
        read_octree(path)


def test_a_failed_write_leaves_the_old_file(path, monkeypatch):
    before = path.read_bytes()
    monkeypatch.setattr("pathlib.Path.replace", lambda *_: (_ for _ in ()).throw(OSError("full")))

    with pytest.raises(WriteError, match="full"):
        write_map(path, mapped(attributes=False))
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["map.octree"]
