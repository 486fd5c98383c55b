"""Moving objects: what was seen through is freed, what was grazed stays, and feet go with the body."""

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.octree.bit_planes import ALL_SET, NONE_SET, dilate, neighbours_of, words_of
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import codes_of_keys, keys_of
from mapper.octree.map import OctreeMap
from mapper.octree.moving_objects import remove_moving_objects
from mapper.octree.ray_casting import Caster
from mapper.octree.scan_updates import pack
from mapper.sensing.config import DepthNoiseConfig

CONFIG = OctreeConfig(resolution_m=0.2, max_range_m=30.0)
EYE_M = 1.62
GROUND_M = 0.05
"""The ground lies low in the voxels 0 … 0.2 m."""


def rays(ring_step_rad=0.01, azimuth_step_rad=0.01):
    elevation, azimuth = np.meshgrid(
        np.arange(-1.2, 0.2, ring_step_rad), np.arange(-np.pi, np.pi, azimuth_step_rad), indexing="ij"
    )
    flat = np.cos(elevation)
    return np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], -1).reshape(-1, 3)


def box_range_m(origin, directions, low, high):
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / directions, (high - origin) / directions
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.where((enter <= leave) & (enter > 0.0), enter, np.inf)


DENSE = rays()


def scan_of(boxes, *, x_m=0.0, directions=DENSE, reach_m=12.0):
    """Return points, in the world, on flat ground, a wall at x = 9 m, and boxes (low, high)."""
    origin = np.array([x_m, 0.03, EYE_M])
    with np.errstate(divide="ignore"):
        ground_m = np.where(directions[:, 2] < 0, (GROUND_M - EYE_M) / directions[:, 2], np.inf)
        wall_m = np.where(directions[:, 0] > 0, (9.05 - x_m) / directions[:, 0], np.inf)
    ranges_m = np.minimum(ground_m, wall_m)
    owner = np.zeros(len(directions), np.int64)
    for number, (low, high) in enumerate(boxes, start=1):
        found_m = box_range_m(origin, directions, np.array(low), np.array(high))
        owner[found_m < ranges_m] = number
        ranges_m = np.minimum(ranges_m, found_m)
    seen = ranges_m < reach_m
    return (origin + directions[seen] * ranges_m[seen, None]).astype(np.float32), owner[seen], origin


def fused(scans, config=CONFIG):
    octree, caster = OctreeMap(config), Caster(config)
    updates = []
    for points, _, origin in scans:
        T_world_body = np.eye(4)
        T_world_body[:3, 3] = origin
        update = pack(caster.cast(Scan(0, (points - origin).astype(np.float32)), T_world_body))
        octree.merge(update)
        updates.append(update)
    return octree, updates


def person(y_m):
    return (4.3, y_m - 0.25, GROUND_M), (4.6, y_m + 0.25, 1.8)


POLE = (3.33, 1.3, GROUND_M), (3.41, 1.38, 2.4)


@pytest.fixture(scope="module")
def street():
    """A sensor backs away from a pole; a person stands for 8 scans, and has walked away after 4 more."""
    ways_m = [-2.0] * 8 + [-1.2, -0.4, 0.4, 1.2] + [None] * 4
    return [
        scan_of([POLE] if y_m is None else [POLE, person(y_m)], x_m=-0.05 * i) for i, y_m in enumerate(ways_m)
    ]


@pytest.fixture(scope="module")
def removed(street):
    """The street's map and what was removed from it."""
    octree, updates = fused(street)
    return octree, remove_moving_objects(octree, lambda: updates)


def gathered(scans):
    """Return the points of all scans and what each of them lies on."""
    points, owner, _ = zip(*scans, strict=True)
    return np.concatenate(points), np.concatenate(owner)


def test_people_leave_and_ground_walls_and_poles_stay(street, removed):
    octree, objects = removed
    points, owner = gathered(street)
    moving, kept = objects.contain(points), octree.are_occupied(points)
    body = (owner == 2) & (points[:, 2] > 0.2)
    assert moving[body].mean() > 0.98
    assert kept[body].mean() < 0.01
    assert moving[owner == 2].mean() > 0.9, "feet in the ground's voxels alone stay"
    assert moving[owner == 1].mean() < 0.01
    assert kept[owner == 1].mean() > 0.95
    assert moving[owner == 0].mean() < 0.001
    assert kept[owner == 0].mean() > 0.98


def test_feet_are_told_from_the_ground_of_the_same_voxel_scan_by_scan(street, removed):
    _, objects = removed
    points, owner = gathered(street)
    moving = np.concatenate([objects.returns_of(points) for points, _, _ in street])
    feet = (owner == 2) & (points[:, 2] < 0.2)
    assert objects.contain(points)[feet].mean() < 0.2
    assert moving[feet].mean() > 0.98
    assert moving[owner == 2].mean() > 0.99
    np.testing.assert_array_equal(
        moving[(owner == 1) & (points[:, 2] > 0.4)],
        objects.contain(points)[(owner == 1) & (points[:, 2] > 0.4)],
    )
    assert moving[owner == 0].mean() < 0.005
    later, *_ = street[-1]
    assert not objects.returns_of(later).any(), "ground stays in scans without a person"


def test_rings_that_lie_more_than_a_voxel_apart_are_of_one_person():
    sparse, ways_m = rays(ring_step_rad=0.05), [-2.0, -2.0, -1.2, -0.4, 0.4, 1.2] + [None] * 16
    scans = [
        scan_of([POLE] if y_m is None else [POLE, person(y_m)], x_m=-0.05 * i, directions=sparse)
        for i, y_m in enumerate(ways_m)
    ]
    octree, updates = fused(scans)

    objects = remove_moving_objects(octree, lambda: updates)

    points, owner = gathered(scans)
    moving = objects.contain(points)
    assert moving[(owner == 2) & (points[:, 2] > 0.2)].mean() > 0.98
    assert not moving[owner == 1].any()
    assert moving[owner == 0].mean() < 0.001


def test_a_post_that_is_thinner_than_the_rays_are_apart_stays():
    post = (4.32, 1.3, GROUND_M), (4.34, 1.32, 2.4)
    scans = []
    for i in range(24):
        turn_rad = 0.01 * (i * 0.37 % 1.0)
        turned = DENSE @ np.array(
            [
                [np.cos(turn_rad), np.sin(turn_rad), 0.0],
                [-np.sin(turn_rad), np.cos(turn_rad), 0.0],
                [0, 0, 1],
            ]
        )
        scans.append(scan_of([post], directions=turned))
    octree, updates = fused(scans)
    hit_by = np.array([(owner == 1).any() for _, owner, _ in scans])
    assert 0.4 < hit_by.mean() < 0.6, "every second scan sees through it"

    objects = remove_moving_objects(octree, lambda: updates)

    points = np.concatenate([points[owner == 1] for points, owner, _ in scans])
    assert not objects.contain(points).any()


def test_what_is_beside_a_voxel_that_was_seen_through_leaves_with_it():
    box = (4.3, -2.0, GROUND_M), (4.6, -1.0, 1.6)
    beside = DENSE[np.arctan2(DENSE[:, 1], DENSE[:, 0]) < -0.26]  # past y = -1.2 m at the box
    scans = [scan_of([box], x_m=-0.05 * i) for i in range(3)]
    scans += [scan_of([], x_m=-0.05 * i, directions=beside) for i in range(3, 12)]
    octree, updates = fused(scans, CONFIG.model_copy(update={"resolution_m": 0.1}))

    objects = remove_moving_objects(octree, lambda: updates)

    points, owner = gathered(scans)
    moving, above = objects.contain(points), points[:, 2] > 0.3
    assert moving[(owner == 1) & above].mean() > 0.95
    assert moving[owner == 0].mean() < 0.001


def test_ground_that_octomap_erases_at_a_slant_is_kept():
    sparse = rays(ring_step_rad=0.03)
    scans = [scan_of([], x_m=-0.61 * i, directions=sparse, reach_m=25.0) for i in range(12)]
    octree, updates = fused(scans)
    points, _ = gathered(scans)
    ground = points[points[:, 2] < 0.1]
    lost = 1.0 - octree.are_occupied(ground).mean()

    objects = remove_moving_objects(octree, lambda: updates)

    assert lost > 0.05
    assert 1.0 - octree.are_occupied(ground).mean() < 0.2 * lost
    assert objects.contain(ground).mean() < 0.001


def test_a_scene_without_motion_loses_nothing_and_time_may_run_backwards(street):
    still = [scan_of([POLE], x_m=-0.05 * i) for i in range(10)]
    octree, updates = fused(still)
    assert len(remove_moving_objects(octree, lambda: updates)) == 0

    (one, updates), (other, _) = fused(street), fused(street)
    remove_moving_objects(one, lambda: updates)
    remove_moving_objects(other, lambda: reversed(updates))
    np.testing.assert_array_equal(one.leaves().log_odds, other.leaves().log_odds)


def test_points_without_a_voxel_are_in_no_moving_thing(removed):
    _, objects = removed
    far = np.array([[1e9, 0.0, 0.0], [np.nan, 0.0, 0.0], [500.0, 500.0, 500.0]])
    assert not objects.contain(far).any()


def dense(codes, plane, *, absent):
    """Return a (48, 48, 48) bool array of 6³ blocks, and the indices of the plane's voxels in it."""
    where = tuple((keys_of(codes)[:, None] * 8 + keys_of(np.arange(512))).reshape(-1, 3).T)
    voxels = np.full((48, 48, 48), absent)
    voxels[where] = np.unpackbits(plane, axis=1, bitorder="little").reshape(-1)
    return voxels, where


@pytest.mark.parametrize("absent", [NONE_SET, ALL_SET])
@pytest.mark.parametrize("density", [0.002, 0.5, 0.998])
def test_a_bit_is_set_where_one_of_27_is(absent, density):
    rng = np.random.default_rng(int(1000 * density))
    blocks = np.argwhere(rng.random((4, 4, 4)) < (0.6 if absent else 1.1)) + 1
    codes = np.sort(codes_of_keys(blocks))
    plane = np.packbits(rng.random((len(codes), 512)) < density, axis=1, bitorder="little")
    before = plane.copy()

    grown = dilate(words_of(plane), neighbours_of(codes), absent=absent)

    voxels, where = dense(codes, plane, absent=bool(absent))
    expected = np.zeros_like(voxels)
    for shift in np.ndindex(3, 3, 3):
        expected |= np.roll(voxels, np.array(shift) - 1, axis=(0, 1, 2))
    np.testing.assert_array_equal(dense(codes, grown.view(np.uint8), absent=False)[0][where], expected[where])
    np.testing.assert_array_equal(plane, before)


def test_neighbours_at_the_ends_of_the_key_range_wrap_to_absent_blocks():
    codes = codes_of_keys(np.array([[0, 0, 0], [8191, 8191, 8191]]))

    rows = neighbours_of(np.sort(codes))

    assert (rows == -1).all()


def test_a_wall_whose_depth_errs_from_view_to_view_does_not_move():
    config = OctreeConfig(depth_noise=DepthNoiseConfig(quadratic_per_m=0.0017))
    x, y = np.meshgrid(np.arange(-0.4, 0.4, 0.008), np.arange(-0.4, 0.4, 0.008))
    directions = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    is_person = (np.abs(directions[:, 0]) < 0.1) & (directions[:, 1] > -0.2)
    scans = []
    for i in range(12):
        depth_m = np.full(len(directions), 3.83 if i < 4 else 4.13)
        depth_m[is_person & (i < 4)] = 2.03
        scans.append(((directions * depth_m[:, None]).astype(np.float32), is_person & (i < 4), np.zeros(3)))
    points, owner = gathered(scans)

    octree, updates = fused(scans, config)
    as_lidar = remove_moving_objects(octree, lambda: updates).contain(points)
    octree, updates = fused(scans, config)
    poses = np.broadcast_to(np.eye(4), (len(scans), 4, 4))
    as_camera = remove_moving_objects(octree, lambda: updates, T_world_camera=poses).contain(points)

    assert as_lidar[~owner].mean() > 0.2
    assert as_camera[~owner].mean() < 0.001
    assert as_camera[owner].mean() > 0.95
