"""docs/formats.md is a specification: readers written from it alone read what mapper writes.

The first reader is the page's own; the second knows struct, zlib and numpy, and nothing of mapper.
"""

import json
import re
import shutil
import struct
import zlib

import numpy as np
import pytest
import zstandard

from mapper.octree.map import read_octree
from mapper.run.files import RUN_FILES
from mapper.run.manifest import Manifest
from tests.support.command_line import mapper
from tests.support.paths import ROOT

PAGE = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def octree_reader():
    """The reader that the page shows."""
    (code,) = re.findall(r"### A reader\n\n```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    names = {}
    exec(compile(code, "docs/formats.md", "exec"), names)
    return names["read_octree"]


def read_updates(path):
    """Yield the settings, then stamp, pose and voxels (block code, number in it, occupied) of each frame."""
    with open(path, "rb") as file:  # noqa: PTH123
        yield json.loads(file.readline())
        while head := file.read(144):
            stamp_ns, *pose, blocks, size = struct.unpack("<q16dII", head)
            plain = zlib.decompress(file.read(size))
            assert len(plain) == 136 * blocks
            codes = np.cumsum(np.frombuffer(plain, "<i8", blocks))
            planes = np.frombuffer(plain, "u1", offset=8 * blocks).reshape(2, blocks, 64)
            free, occupied = np.unpackbits(planes, axis=2, bitorder="little").astype(bool)
            yield stamp_ns, np.array(pose).reshape(4, 4), codes, free, occupied


def summed(path, settings):
    """The log-odds of the map as the page tells to make them of updates, by block code."""

    def log_odds(name):
        p = settings[f"{name}_probability"]
        return np.float32(np.log(p / (1.0 - p)))

    hit, miss, low, high = map(log_odds, ("hit", "miss", "clamp_min", "clamp_max"))
    blocks = {}
    _, *frames = read_updates(path)
    for _, _, codes, free, occupied in frames:
        for code, is_free, is_occupied in zip(codes.tolist(), free, occupied, strict=True):
            values = blocks.setdefault(code, np.full(512, np.nan, np.float32))
            begun = np.where(np.isnan(values), np.float32(0.0), values)
            added = np.clip(begun + np.where(is_occupied, hit, miss), low, high)
            stays = np.where(is_occupied, begun >= high, begun <= low)
            values[:] = np.where(is_free | is_occupied, np.where(stays, begun, added), values)
    return blocks


@pytest.fixture(scope="module")
def run(desk_run, tmp_path_factory):
    """A run that keeps what moved, with attributes."""
    folder = tmp_path_factory.mktemp("formats") / "run"
    shutil.copytree(desk_run.path, folder)
    mapper("fuse", folder, "--set", "octree.moving=kept", "--set", "octree.attributes=true", "--quiet")
    return folder


def keys_of(code):
    """Three keys of Morton codes, bit by bit."""
    return np.stack([sum((code >> (3 * b + axis) & 1) << b for b in range(16)) for axis in range(3)], axis=1)


def test_the_pages_reader_reads_every_voxel_of_an_octree(run, octree_reader):
    keys, log_odds, header = octree_reader(run / "map.octree")

    ours = read_octree(run / "map.octree")
    centres = (keys - 32768 + 0.5) * header["config"]["resolution_m"]
    assert len(keys) == len(np.unique(keys, axis=0)) == header["voxels"] > 10_000
    np.testing.assert_array_equal(ours.log_odds_at(centres), log_odds)
    limit = np.log(header["config"]["occupied_probability"] / (1 - header["config"]["occupied_probability"]))
    np.testing.assert_array_equal(ours.are_occupied(centres), log_odds >= np.float32(limit))
    leaves = ours.leaves()
    own, theirs = np.lexsort(keys.T), np.lexsort(leaves.keys.T)
    np.testing.assert_array_equal(keys[own], leaves.keys[theirs])
    np.testing.assert_array_equal(centres[own], leaves.centres_world[theirs])


def test_attributes_stand_where_the_page_says(run, octree_reader):
    _, _, header = octree_reader(run / "map.octree")
    data = (run / "map.octree").read_bytes()
    (length,) = struct.unpack_from("<I", data, 20)
    body = zstandard.ZstdDecompressor().decompress(data[28 + length :])
    blocks, voxels = header["attribute_blocks"], header["attribute_voxels"]
    at = 72 * header["blocks"] + 4 * header["voxels"]
    codes = np.cumsum(np.frombuffer(body, "<i8", blocks, at))
    bits = np.frombuffer(body, "u1", 64 * blocks, at + 8 * blocks).reshape(blocks, 64)
    block, voxel = np.nonzero(np.unpackbits(bits, axis=1, bitorder="little"))
    columns = np.frombuffer(body, "<u4", 5 * voxels, at + 72 * blocks).reshape(5, voxels)
    last_seen = np.frombuffer(body, "<i8", voxels, at + 72 * blocks + 20 * voxels)
    assert at + 72 * blocks + 28 * voxels == len(body)

    octree = read_octree(run / "map.octree")
    centres = (keys_of(codes[block] << 9 | voxel) - 32768 + 0.5) * header["config"]["resolution_m"]
    ours = octree.attributes.at(centres)
    assert voxels > 1000
    np.testing.assert_array_equal(ours.hits, columns[4])
    np.testing.assert_array_equal(ours.last_seen_ns, last_seen)
    weights = columns[3]
    mean = columns[:3, weights > 0] / weights[weights > 0]
    assert np.abs(ours.colors[weights > 0] - mean.T).max() <= 0.5


def test_the_sum_of_the_scan_updates_is_the_map_to_the_last_bit(run, octree_reader):
    keys, log_odds, header = octree_reader(run / "map.octree")

    blocks = summed(run / "scan_updates.bin", header["config"])

    codes = np.repeat(list(blocks), 512) << 9 | np.tile(np.arange(512), len(blocks))
    values = np.concatenate(list(blocks.values()))
    known = ~np.isnan(values)
    order, own = (np.lexsort(k.T) for k in (keys_of(codes[known]), keys))
    np.testing.assert_array_equal(keys_of(codes[known])[order], keys[own])
    np.testing.assert_array_equal(values[known][order], log_odds[own])


def test_scan_updates_have_the_tracked_frames_at_their_poses(run):
    settings, *frames = read_updates(run / "scan_updates.bin")

    assert list(settings) == ["format", "resolution_m", "max_range_m", "depth_noise", "discretize"]
    rows = [line.split(",") for line in (run / "poses.csv").read_text().splitlines()[1:]]
    tracked = {int(row[0]): np.array([float(x) for x in row[2:5]]) for row in rows if row[1] == "tracked"}
    assert [stamp_ns for stamp_ns, *_ in frames] == sorted(tracked)
    for stamp_ns, pose, codes, free, occupied in frames:
        np.testing.assert_allclose(pose[:3, 3], tracked[stamp_ns], atol=1e-9)
        assert (np.diff(codes) > 0).all()
        assert not (free & occupied).any()


def test_the_tables_of_columns_have_every_column_of_the_files(run):
    for name, table in (("frames.csv", "**`frames.csv`**"), ("poses.csv", "**`poses.csv`**")):
        section = PAGE[PAGE.index(table) :].split("\n\n**")[0]
        named = re.findall(r"^\| (`[^|]*) \|", section, re.MULTILINE)
        columns = (run / name).read_text().splitlines()[0].split(",")
        first, last = 0, 0
        for cell in named:
            names = re.findall(r"`(\w+)`", cell)
            first = columns.index(names[0])
            assert first == last, f"{name}: {names[0]}"
            last = columns.index(names[-1]) + 1
        assert last == len(columns)


def test_every_key_of_a_loop_and_of_the_manifest_is_explained(run):
    manifest = PAGE[PAGE.index("## manifest.json") :].split("\n## ")[0]
    for name in Manifest.model_fields:
        assert f"`{name}`" in manifest, name
    loops = PAGE[PAGE.index("## loops.jsonl") :].split("\n## ")[0]
    lines = (run / "loops.jsonl").read_text().splitlines()
    for name in {key for line in lines for key in json.loads(line)}:
        assert f"`{name}`" in loops, name


def test_the_grids_pixels_are_those_of_the_page(run):
    pixels = (run / "slice.pgm").read_bytes()
    magic, comment, size, most, _ = pixels.split(b"\n", 4)
    width, height = map(int, size.split())
    assert (magic, comment[:1], most) == (b"P5", b"#", b"255")
    assert set(pixels[-width * height :]) <= {254, 0, 205}
    for line in (run / "slice.yaml").read_text().splitlines():
        key, _, value = line.partition(": ")
        assert f"`{key}" in PAGE, key
        if key in ("mode", "negate", "occupied_thresh", "free_thresh"):
            assert f"`{key}: {value}`" in PAGE


def test_every_file_of_a_run_is_explained():
    pictures = {
        *("slice.png", "traversable.png", "keepout.png", "costmap.png", "summary.png", "cloud.png"),
        *("plan.png", "run.rrd"),
    }
    body = PAGE.split("## Conventions", 1)[1].split("## map.octree", 1)
    for name in {name for files in RUN_FILES for name in files.names} - pictures:
        stem = name.partition(".")[0] if name.endswith((".pgm", ".yaml")) else name
        assert re.search(rf"## {re.escape(name)}|\*\*`{re.escape(stem)}`\*\*", "## map.octree" + body[1]), (
            name
        )
