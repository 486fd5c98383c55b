"""Voxels in a file beyond a limit."""

import errno
import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from mapper.core.errors import WriteError
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.octree.octomap_file import write_ot
from tests.support.paths import ROOT

FILL = """
import resource, sys
from pathlib import Path
import numpy as np
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from tests.octree.test_blocks_in_a_file import digest_of, filled

filled(OctreeMap(0.1), blocks=10)  # kernels are loaded
used = 4096 * int(Path("/proc/self/statm").read_text().split()[5])
resource.setrlimit(resource.RLIMIT_DATA, (used + 64_000_000,) * 2)
for limit_mb in (None, 0.1, 20.0):
    octree = OctreeMap(OctreeConfig(resolution_m=0.1, max_memory_mb=limit_mb), folder=Path(sys.argv[1]))
    try:
        print(digest_of(filled(octree, blocks=100_000)))
    except MemoryError:
        print("no memory")
    del octree
"""


def filled(octree, *, blocks, at_once=500):
    """Return the map with so many blocks of noise, added some at a time."""
    rng = np.random.default_rng(0)
    for first in range(0, blocks, at_once):
        codes = np.arange(first, min(first + at_once, blocks)) << 3 | 1
        slots = octree.blocks.claim(codes)
        octree.blocks.table.values[slots] = rng.integers(-2, 3, (len(slots), 1))
    return octree


def digest_of(octree):
    digest = hashlib.sha256()
    for slots in np.array_split(octree.blocks.sorted_slots(), 50):
        digest.update(octree.blocks.codes[slots].tobytes() + octree.blocks.table.values[slots].tobytes())
    return digest.hexdigest()


def test_a_map_of_205_mb_is_made_in_64_mb_of_memory(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FILL, str(tmp_path)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    wanted = digest_of(filled(OctreeMap(0.1), blocks=100_000))
    assert done.stdout.splitlines() == ["no memory", wanted, wanted]
    assert not list(tmp_path.iterdir())  # the file has no name


def test_a_map_that_comes_to_the_limit_keeps_what_it_has(tmp_path):
    config = OctreeConfig(resolution_m=0.1, max_memory_mb=0.5)
    rng = np.random.default_rng(0)
    in_file, in_memory = OctreeMap(config, folder=tmp_path), OctreeMap(config)
    for _ in range(30):
        origin = rng.uniform(-3.0, 3.0, 3)
        points = (origin + rng.normal(0.0, 1.0, (500, 3))).astype(np.float32)
        for octree in (in_file, in_memory):
            octree.insert_points(points, origin)
    np.testing.assert_array_equal(in_file.blocks.codes, in_memory.blocks.codes)
    np.testing.assert_array_equal(in_file.query(points), in_memory.query(points))
    for name, octree in (("file.ot", in_file), ("memory.ot", in_memory)):
        write_ot(tmp_path / name, octree)
    assert in_file.memory_bytes > 1e6
    assert (tmp_path / "file.ot").read_bytes() == (tmp_path / "memory.ot").read_bytes()


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    octree = OctreeMap(OctreeConfig(resolution_m=0.1, max_memory_mb=0.1), folder=tmp_path)
    with pytest.raises(WriteError, match="No space left on device; is there space"):
        filled(octree, blocks=200)
    assert len(octree.blocks) < 200
