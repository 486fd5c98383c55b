"""Real scans changed in ways that do not change the path, or change it as is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapper.core.geometry import apply, inverse, length_and_angle, transform
from mapper.core.rotations import rotation_from_euler
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.sources import open_source
from tests.support.paths import KITTI

pytestmark = pytest.mark.skipif(not KITTI.is_dir(), reason=f"{KITTI} is not here")
SCANS = 8
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@cache
def recorded():
    entries = open_source(KITTI).entries()
    return [entry.scan() for _, entry in zip(range(SCANS), entries, strict=False)]


def last_pose(change):
    """Return the pose (4, 4) of the last scan in the first, of scans whose points are changed."""
    odometry = build_frame_odometry(GicpOdometryConfig())
    for scan in recorded():
        changed = replace(
            scan, points_body=np.asarray(change(scan.points_body), np.float32), times_s=None, intensities=None
        )
        pose = odometry.track(odometry.observe(changed)).T_world_body
    return pose


@cache
def unchanged():
    return last_pose(lambda points: points)


def turned(roll_deg, pitch_deg, yaw_deg):
    return transform(rotation_from_euler(*np.radians([roll_deg, pitch_deg, yaw_deg])), np.zeros(3))


@pytest.mark.parametrize(
    "axes",
    [
        turned(0.0, 0.0, 90.0),
        turned(0.0, 40.0, 0.0),
        turned(180.0, 0.0, 0.0),
        turned(35.0, -20.0, 200.0),
        MIRROR,
    ],
    ids=["yaw", "tilt", "upside down", "all", "mirror"],
)
def test_the_path_does_not_depend_on_the_sensors_axes(axes):
    found = last_pose(lambda points: apply(axes, points))
    off_m, off_rad = length_and_angle(inverse(unchanged()) @ inverse(axes) @ found @ axes)
    assert off_m < 0.03
    assert off_rad < np.radians(0.2)


def thinned(points):
    return points[np.random.default_rng(1).random(len(points)) < 0.5]


def shuffled(points):
    return np.random.default_rng(2).permutation(points)


def rounded(points):
    return np.round(points * 20.0) / 20.0


def noisy(points):
    ranges = np.linalg.norm(points, axis=1, keepdims=True)
    return points * (1.0 + np.random.default_rng(3).normal(0.0, 0.05, ranges.shape) / ranges)


def near(points):
    return points[np.linalg.norm(points, axis=1) < 25.0]


def ahead(points):
    return points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.radians(60.0)]


@pytest.mark.parametrize("change", [thinned, shuffled, rounded, noisy, near, ahead])
def test_the_path_does_not_depend_on_which_points_show_it(change):
    off_m, off_rad = length_and_angle(inverse(unchanged()) @ last_pose(change))
    assert off_m < 0.04
    assert off_rad < np.radians(0.3)


def test_scans_backwards_give_the_way_back():
    odometry = build_frame_odometry(GicpOdometryConfig())
    stamps_ns = [scan.stamp_ns for scan in recorded()]
    for stamp_ns, scan in zip(stamps_ns, reversed(recorded()), strict=True):
        pose = odometry.track(odometry.observe(replace(scan, stamp_ns=stamp_ns))).T_world_body
    off_m, off_rad = length_and_angle(unchanged() @ pose)
    assert off_m < 0.04
    assert off_rad < np.radians(0.3)
