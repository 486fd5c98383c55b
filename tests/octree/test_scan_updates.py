"""Fusing again from stored scan updates: only frames that moved are read, and the bits are the same."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.build import BuildConfig
from mapper.config.loading import overridden
from mapper.core.errors import DataError, MapFileError
from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.core.trajectory import Trajectory
from mapper.mapping.config import Edits
from mapper.mapping.map_building import build_maps
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.octree.ray_casting import Caster
from mapper.octree.scan_updates import ScanUpdateWriter, decompress, displacement_m, open_scan_updates, pack
from mapper.runtime.progress import SILENT
from mapper.simulation import CameraSimulator
from mapper.simulation.config import SynthConfig

FRAMES = 16
CONFIG = overridden(BuildConfig(), ["cloud.frame_stride=1000", "mcap.image_stride=0", "workers=0"])
OVER_HERE = exp(np.array([0.0, 0.0, 0.2]), np.array([0.3, -0.1, 0.02]))


class Counted:
    """A log that counts which of its frames are read."""

    def __init__(self, source):
        self.read = []

        def entry_at(index):
            entry = source.entry_at(index)

            def scan():
                self.read.append(entry.stamp_ns)
                return entry.scan()

            return replace(entry, returns=scan)  # the cloud reads the first frame

        self.log = replace(source, entry_at=entry_at)


@pytest.fixture(scope="module")
def source():
    config = SynthConfig(
        width_px=160,
        height_px=120,
        texture_px_per_m=16,
        furniture_per_room=3,
        posters_per_room=0,
        frame_rate_hz=5.0,
        duration_s=(FRAMES - 1) / 5.0,
    )
    return CameraSimulator(config).log()


@pytest.fixture(scope="module")
def first(source, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scan_updates")
    fused(source, source.truth, folder / "first.bin")
    return folder / "first.bin"


def fused(source, trajectory, path, *, before=None, config=CONFIG):
    with ScanUpdateWriter(path, config.octree) as after:
        maps = build_maps(
            source,
            trajectory,
            config,
            progress=SILENT,
            on_snapshot=lambda _snapshot: None,
            cached=before,
            updates=after,
            edits=Edits(),
        )
    return maps.octree


def moved(trajectory, indices, T_new_world=OVER_HERE):
    poses = trajectory.T_world_body.copy()
    for i in indices:
        poses[i] = T_new_world @ poses[i]
    return Trajectory(trajectory.stamps_ns, poses)


def assert_same_bits(ours, theirs):
    a, b = ours.leaves(), theirs.leaves()
    np.testing.assert_array_equal(a.keys, b.keys)
    np.testing.assert_array_equal(a.log_odds.view(np.int32), b.log_odds.view(np.int32))


@pytest.mark.parametrize("moving", ["removed", "kept"])
@pytest.mark.parametrize(
    "indices",
    [[], [7], range(FRAMES - 4, FRAMES), range(FRAMES)],
    ids=["none", "one", "tail", "all"],
)
def test_only_frames_that_moved_are_read_and_the_bits_are_those_of_fusing_from_scratch(
    source, first, tmp_path, indices, moving
):
    config = overridden(CONFIG, [f"octree.moving={moving}"])
    trajectory, counted = moved(source.truth, indices), Counted(source)

    with open_scan_updates(first) as before:
        again = fused(counted.log, trajectory, tmp_path / "again.bin", before=before, config=config)

    scratch = fused(source, trajectory, tmp_path / "scratch.bin", config=config)
    assert counted.read == [int(source.truth.stamps_ns[i]) for i in indices]
    assert_same_bits(again, scratch)
    assert (tmp_path / "again.bin").read_bytes() == (tmp_path / "scratch.bin").read_bytes()


def test_frames_that_left_and_frames_that_came_are_right_too(source, first, tmp_path):
    truth = source.truth
    fewer = Trajectory(truth.stamps_ns[3:], truth.T_world_body[3:])
    counted = Counted(source)

    with open_scan_updates(first) as before:
        assert_same_bits(
            fused(counted.log, fewer, tmp_path / "fewer.bin", before=before),
            fused(source, fewer, tmp_path / "a"),
        )
    with open_scan_updates(tmp_path / "fewer.bin") as before:
        assert_same_bits(
            fused(counted.log, truth, tmp_path / "more.bin", before=before),
            fused(source, truth, tmp_path / "b"),
        )

    assert counted.read == truth.stamps_ns[:3].tolist()


def test_another_sensor_model_needs_no_frame_and_another_resolution_needs_all(source, first, tmp_path):
    for override, reads in (("octree.hit_probability=0.6", 0), ("octree.resolution_m=0.1", FRAMES)):
        config, counted = overridden(CONFIG, [override]), Counted(source)
        with open_scan_updates(first) as before:
            again = fused(counted.log, source.truth, tmp_path / "again.bin", before=before, config=config)
        assert len(counted.read) == reads
        assert_same_bits(again, fused(source, source.truth, tmp_path / "scratch.bin", config=config))


def test_within_the_tolerance_frames_stay_as_they_were_fused_and_do_not_drift(source, first, tmp_path):
    step = exp(np.zeros(3), np.array([0.015, 0.0, 0.0]))
    nudged = moved(source.truth, [2], step)
    nudged_again = moved(nudged, [2], step)
    counted = Counted(source)

    with open_scan_updates(first, within_m=0.02) as before:
        stayed = fused(counted.log, nudged, tmp_path / "stayed.bin", before=before)
    assert counted.read == []
    assert_same_bits(stayed, fused(source, source.truth, tmp_path / "scratch.bin"))

    with open_scan_updates(tmp_path / "stayed.bin", within_m=0.02) as before:
        went = fused(counted.log, nudged_again, tmp_path / "went.bin", before=before)
    assert counted.read == [int(source.truth.stamps_ns[2])]
    assert_same_bits(went, fused(source, nudged_again, tmp_path / "scratch.bin"))


@pytest.mark.parametrize("seed", range(20))
def test_the_displacement_bounds_every_point_in_range(seed):
    rng = np.random.default_rng(seed)
    T_a, T_b = (exp(rng.normal(0.0, 0.2, 3), rng.normal(0.0, 1.0, 3)) for _ in range(2))
    points = rng.normal(size=(500, 3))
    points *= 4.0 / np.linalg.norm(points, axis=1, keepdims=True)

    apart_m = np.linalg.norm(
        (points @ T_a[:3, :3].T + T_a[:3, 3]) - (points @ T_b[:3, :3].T + T_b[:3, 3]), axis=1
    )

    assert apart_m.max() <= displacement_m(T_a, T_b, range_m=4.0)
    assert displacement_m(T_a, T_a.copy(), range_m=4.0) == 0.0


@pytest.mark.parametrize("discretize", [True, False])
def test_merging_a_scan_update_is_inserting_its_scan(discretize):
    rng = np.random.default_rng(3)
    config = OctreeConfig(discretize=discretize, max_range_m=2.5)
    inserted, merged, caster = OctreeMap(config), OctreeMap(config), Caster(config)
    for _ in range(5):
        scan = Scan(0, rng.normal(0.0, 2.0, (200, 3)).astype(np.float32))
        T_world_body = exp(rng.normal(0.0, 1.0, 3), rng.normal(0.0, 3.0, 3))
        inserted.insert(scan, T_world_body)
        update = pack(caster.cast(scan, T_world_body))
        merged.merge(decompress(update.compress(), blocks=len(update)))

    assert len(inserted) == len(merged)
    assert_same_bits(inserted, merged)


def test_damaged_files_are_refused_in_one_line(first, tmp_path):
    data, damaged = first.read_bytes(), tmp_path / "damaged.bin"
    for content, fault in (
        (b"something else\n", "not 'mapper sights 1'"),
        (data[:-1], "truncated after 15 frames"),
        (data[: data.index(b"\n") + 20], "truncated after 0 frames"),
    ):
        damaged.write_bytes(content)
        with pytest.raises(MapFileError, match=fault):
            open_scan_updates(damaged)
    with pytest.raises(MapFileError, match="cannot be read"):
        open_scan_updates(tmp_path / "missing.bin")
    for garbled in (b"garbled", b"x\x9c\x03\x00\x00\x00\x00\x01"):
        with pytest.raises(DataError, match="scan update of 3 blocks: damaged"):
            decompress(garbled, blocks=3)
