import resource
from pathlib import Path

import numpy as np
import pytest

from mapper.core.errors import DataError, MapSizeError
from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.octree import ray_casting_kernels as kernels
from mapper.octree import sparse_grid
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.octree.octomap_file import write_bt, write_ot
from tests.support.octomap_oracle import fr1_xyz_scans, fuse, kitti_scans, voxels
from tests.support.octree_maps import as_dict, octree_of
from tests.support.paths import FR1_XYZ, KITTI

BOTH_MODES = pytest.mark.parametrize("discretize", [True, False], ids=["discretize", "every-point"])


def random_scans(seed, *, scans=4, points=50, spread_m=2.0):
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-20.0, 20.0, 3)
    return [
        (
            (centre + rng.normal(0.0, spread_m, (points, 3))).astype(np.float32),
            centre + rng.normal(0.0, 0.5, 3),
        )
        for _ in range(scans)
    ]


@BOTH_MODES
@pytest.mark.parametrize("resolution_m", [0.05, 0.1, 0.37])
@pytest.mark.parametrize("seed", range(4))
def test_equals_octomap_on_random_clouds(seed, resolution_m, discretize):
    # Half of the rays are longer than 2.5 m, so both kinds occur; keys are negative and positive.
    settings = {"resolution_m": resolution_m, "max_range_m": 2.5, "discretize": discretize}
    scans = random_scans(seed)

    octree = octree_of(scans, **settings)

    theirs = voxels(fuse(scans, **settings), resolution_m=resolution_m)
    assert as_dict(octree) == theirs  # keys, and log-odds as float32 bits: == on floats
    assert len(octree) == len(theirs)


@BOTH_MODES
@pytest.mark.parametrize(
    "points",
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]],  # along axes
        [[1, 1, 1], [-1, -1, -1], [1, 1, 0], [-1, 1, 0], [0.5, -0.5, 0.5]],  # through voxel corners: ties
        [[0.01, 0.01, 0.01], [0, 0, 0], [0.04, 0.0, 0.0]],  # in the sensor's own voxel
        [[3.0, 4.0, 0.0], [0.0, 2.5, 0.0], [2.5, 0.0, 0.0], [0.0, 0.0, 2.55]],  # at and just over the range
        [[0.05 * n, 0.0, 0.3] for n in range(-8, 9)],  # on voxel borders
    ],
    ids=["axes", "diagonals", "own-voxel", "range", "borders"],
)
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.025, 0.025, 0.025), (-7.01, 3.3, 0.049)])
def test_equals_octomap_on_awkward_rays(points, origin, discretize):
    settings = {"resolution_m": 0.05, "max_range_m": 2.5, "discretize": discretize}
    origin = np.array(origin)
    scans = [((np.array(points) + shift).astype(np.float32), origin) for shift in (0.0, origin, 0.5 * origin)]

    assert as_dict(octree_of(scans, **settings)) == voxels(fuse(scans, **settings), resolution_m=0.05)


@BOTH_MODES
def test_equals_octomap_far_from_the_map_and_without_a_range(discretize):
    # The sensor stands outside everything mapped before, and the last scan spans most of the key range.
    points = random_scans(3)[0][0]
    scans = [
        (points, points.mean(axis=0)),
        (points, np.array([-150.0, 90.0, 3.0])),
        (points[:3] * -14, points[4]),
    ]
    scans = [(points, origin.astype(np.float64)) for points, origin in scans]

    ours = octree_of(scans, resolution_m=0.5, max_range_m=np.inf, discretize=discretize)

    theirs = fuse(scans, resolution_m=0.5, max_range_m=-1.0, discretize=discretize)
    assert as_dict(ours) == voxels(theirs, resolution_m=0.5)


@BOTH_MODES
@pytest.mark.skipif(not (FR1_XYZ.exists() and KITTI.exists()), reason="needs ../shared/data")
@pytest.mark.parametrize(
    ("scans_of", "resolution_m", "max_range_m"), [(fr1_xyz_scans, 0.05, 4.0), (kitti_scans, 0.4, 60.0)]
)
def test_equals_octomap_on_real_frames(scans_of, resolution_m, max_range_m, discretize, tmp_path):
    settings = {"resolution_m": resolution_m, "max_range_m": max_range_m, "discretize": discretize}
    scans = scans_of(3)

    octree, tree = octree_of(scans, **settings), fuse(scans, **settings)
    write_ot(tmp_path / "map.ot", octree)
    write_bt(tmp_path / "map.bt", octree)
    assert (tmp_path / "map.ot").read_bytes() == tree.write()
    assert (tmp_path / "map.bt").read_bytes() == tree.writeBinary()


@BOTH_MODES
def test_a_scan_is_its_points_at_the_pose(discretize):
    rng = np.random.default_rng(5)
    T_world_body = exp(np.array([0.3, -0.2, 1.1]), np.array([4.0, -2.0, 1.0]))
    scan = Scan(0, rng.normal(0.0, 2.0, (500, 3)).astype(np.float32), origin_body=np.array([0.1, 0.2, 0.3]))
    octree = OctreeMap(OctreeConfig(discretize=discretize, max_range_m=4.0))

    octree.insert(scan, T_world_body)

    points_world = kernels.to_world(scan.points_body, T_world_body)
    np.testing.assert_allclose(
        points_world, scan.points_body @ T_world_body[:3, :3].T + T_world_body[:3, 3], atol=1e-5
    )
    origin_world = T_world_body[:3, :3] @ scan.origin_body + T_world_body[:3, 3]
    assert as_dict(octree) == as_dict(octree_of([(points_world, origin_world)], discretize=discretize))


def test_log_odds_of_exactly_zero_are_known():
    config = OctreeConfig(hit_probability=0.75, miss_probability=0.25)
    octree = OctreeMap(config)
    ahead, origin = np.array([[0.525, 0.025, 0.025]], np.float32), np.full(3, 0.025)
    octree.insert_points(ahead, origin)
    octree.insert_points(ahead + np.float32([0.5, 0, 0]), origin)

    assert octree.log_odds_at(ahead.astype(np.float64)).tolist() == [0.0]
    assert len(octree) == len(octree.leaves().keys) == 21


@pytest.mark.parametrize("through_unknown", [True, False])
def test_rays_end_where_octomap_ends_them(through_unknown):
    rng = np.random.default_rng(0)
    rough_sphere = rng.normal(0.0, 1.0, (20000, 3))
    rough_sphere *= rng.uniform(1.2, 1.3, (20000, 1)) / np.linalg.norm(rough_sphere, axis=1, keepdims=True)
    scans = [(rough_sphere.astype(np.float32), np.zeros(3))]
    octree, tree = octree_of(scans), fuse(scans, resolution_m=0.05, max_range_m=4.0, discretize=True)
    origins = rng.normal(0.0, 0.3, (200, 3)).astype(np.float32).astype(np.float64)
    directions = rng.normal(0.0, 1.0, (200, 3)).astype(np.float32).astype(np.float64)
    directions[:6] = np.vstack([np.eye(3), -np.eye(3)])

    rays = octree.cast_rays(origins, directions, max_range_m=1.5, through_unknown=through_unknown)

    hits = 0
    for i in range(len(origins)):
        end = np.zeros(3)
        hit = tree.castRay(origins[i], directions[i], end, ignoreUnknownCells=through_unknown, maxRange=1.5)
        assert hit == rays.hits[i]
        if hit:
            hits += 1
            np.testing.assert_allclose(rays.centres_world[i], end, atol=1e-5)
            assert rays.distances_m[i] == pytest.approx(np.linalg.norm(rays.centres_world[i] - origins[i]))
    assert 20 < hits < 180  # both outcomes were compared


def test_rays_that_cannot_be_cast_are_refused():
    octree = octree_of(random_scans(2))
    for origins, directions in (
        (np.zeros((2, 3)), np.zeros((2, 3))),
        (np.zeros((2, 3)), np.full((2, 3), np.nan)),
        (np.full((1, 3), 1e9), np.ones((1, 3))),
        (np.zeros((2, 3)), np.ones((3, 3))),
    ):
        with pytest.raises(DataError, match="octree"):
            octree.cast_rays(origins, directions, max_range_m=1.0, through_unknown=True)


@BOTH_MODES
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1700.0, -1700.0])
def test_points_without_a_key_are_refused(bad, discretize):
    octree = octree_of(random_scans(6), discretize=discretize)
    before = as_dict(octree)
    points = np.zeros((400, 3), np.float32)
    points[300, 1] = bad

    with pytest.raises(DataError, match="points"):
        octree.insert_points(points, np.zeros(3))
    assert as_dict(octree) == before


@BOTH_MODES
@pytest.mark.parametrize("bad", [np.nan, 1700.0])
def test_an_origin_without_a_key_is_refused(bad, discretize):
    octree = octree_of([], discretize=discretize)

    with pytest.raises(DataError, match=r"sensor origin .* ±1638\.4 m"):
        octree.insert_points(np.zeros((4, 3), np.float32), np.array([0.0, bad, 0.0]))


def test_an_empty_scan_changes_nothing():
    octree = octree_of([(np.zeros((0, 3), np.float32), np.zeros(3))])

    assert len(octree) == 0
    assert len(octree.leaves().keys) == 0


def test_a_scan_too_large_for_its_resolution_is_refused_before_it_is_allocated():
    corners = np.array([[30, 30, 30], [-30, -30, -30]], np.float32)

    with pytest.raises(MapSizeError, match=r"scan of 600\d×600\d×600\d voxels needs 512 GiB .* resolution_m"):
        octree_of([(corners, np.zeros(3))], resolution_m=0.01, max_range_m=200.0)


def test_working_space_is_only_as_large_as_what_rays_cross():
    def resident_bytes():
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    octree = octree_of([(np.zeros((1, 3), np.float32), np.ones(3))], resolution_m=0.1, max_range_m=80.0)
    corners = np.array([[40, 40, 20], [-40, -40, -20], [40, -40, 20]], np.float32)
    before = resident_bytes()

    octree.insert_points(corners, np.zeros(3))

    assert resident_bytes() - before < 800 * 800 * 400 / 20


def test_a_map_too_large_for_memory_is_refused_and_stays_as_it_was(monkeypatch):
    octree = octree_of(random_scans(7)[:1])
    before = as_dict(octree)
    monkeypatch.setattr(
        sparse_grid.os, "sysconf", lambda name: {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 1}[name]
    )
    with pytest.raises(MapSizeError, match=r"blocks of 8³ voxels needs .* GiB"):
        octree.insert_points(random_scans(8, points=300)[0][0], random_scans(8)[0][1])
    monkeypatch.undo()

    assert as_dict(octree) == before
    octree.insert_points(np.full((1, 3), 0.025, np.float32), np.full(3, 0.025))
    assert len(octree) == len(before) + 1  # nothing of the refused scan is left in the window
