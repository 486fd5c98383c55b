"""Normals of scan lines: from the lines beside them on walls and ground, unchanged on thin objects."""

import numpy as np
import pytest

from mapper.registration.surfaces import prepared

ELEVATIONS_RAD = np.radians(np.arange(-15.0, 16.0, 2.0))
VOXEL_M = 0.4
HEIGHT_M = 1.8
WALL_M = 65.0


def scan(*surfaces, origin=(0.0, 0.0, 0.0)):
    """Return what a sensor with 16 rings sees of surfaces, by their ranges, with 2 cm of noise."""
    azimuths = np.radians(np.arange(0.0, 360.0, 0.2))
    elevation, azimuth = (grid.ravel() for grid in np.meshgrid(ELEVATIONS_RAD, azimuths, indexing="ij"))
    across = np.cos(elevation)
    beams = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])
    ranges_m = np.min([surface(beams) for surface in surfaces], axis=0)
    ranges_m = ranges_m + np.random.default_rng(1).normal(0.0, 0.02, len(beams))
    seen = ranges_m < 90.0
    return beams[seen] * ranges_m[seen, None] + np.asarray(origin)


def plane(normal, distance_m):
    """Return the ranges at which beams hit a plane at a distance along its normal."""

    def ranges_m(beams):
        along = beams @ np.asarray(normal)
        return np.where(along > 1e-3, distance_m / np.maximum(along, 1e-3), np.inf)

    return ranges_m


def pole(x, y, radius_m):
    """Return the ranges at which beams hit an upright cylinder."""

    def ranges_m(beams):
        flat = np.linalg.norm(beams[:, :2], axis=1)
        middle = (beams[:, 0] * x + beams[:, 1] * y) / flat
        off = radius_m**2 - (x**2 + y**2 - middle**2)
        near = middle - np.sqrt(np.maximum(off, 0.0))
        return np.where((off > 0.0) & (middle > 0.0), near / flat, np.inf)

    return ranges_m


GROUND, WALL = plane((0.0, 0.0, -1.0), HEIGHT_M), plane((1.0, 0.0, 0.0), WALL_M)


def angles_deg(normals, axis):
    return np.degrees(np.arccos(np.minimum(np.abs(normals @ np.asarray(axis)), 1.0)))


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.5, -0.3, 1.7)])
def test_rings_on_a_wall_and_on_the_ground_have_their_normals(origin):
    points = scan(GROUND, WALL, origin=origin)
    alone = prepared(points, voxel_m=VOXEL_M)
    cloud = prepared(points, voxel_m=VOXEL_M, origin=np.asarray(origin))
    seen = cloud.points - np.asarray(origin)
    on_wall = (np.abs(seen[:, 0] - WALL_M) < 0.2) & (seen[:, 2] > 0.0) & (np.abs(seen[:, 1]) < 50.0)
    on_ground = (np.abs(seen[:, 2] + HEIGHT_M) < 0.1) & (np.hypot(seen[:, 0], seen[:, 1]) > 12.0)

    assert np.quantile(angles_deg(cloud.normals[on_wall], (1.0, 0.0, 0.0)), 0.9) < 5.0
    assert np.quantile(angles_deg(alone.normals[on_wall], (1.0, 0.0, 0.0)), 0.5) > 30.0
    off_ground = angles_deg(cloud.normals, (0.0, 0.0, 1.0))[on_ground]
    assert np.median(off_ground) < 0.2 * np.median(angles_deg(alone.normals[on_ground], (0.0, 0.0, 1.0)))
    assert np.allclose(np.linalg.norm(cloud.normals, axis=1), 1.0)
    assert ((cloud.normals * cloud.points).sum(axis=1) <= 0.0).all()
    assert np.median(cloud.breadth[on_wall]) > 100.0


def test_a_pole_before_the_ground_keeps_its_normals():
    points = scan(GROUND, pole(9.0, 2.0, 0.15))
    alone, cloud = (prepared(points, voxel_m=VOXEL_M, origin=o) for o in (None, np.zeros(3)))
    on_pole = (np.hypot(cloud.points[:, 0] - 9.0, cloud.points[:, 1] - 2.0) < 0.3) & (
        cloud.points[:, 2] > 0.3 - HEIGHT_M
    )
    assert on_pole.sum() > 5
    assert np.array_equal(cloud.normals[on_pole], alone.normals[on_pole])
    assert np.array_equal(cloud.breadth[on_pole], alone.breadth[on_pole])


def test_a_single_scan_line_keeps_its_normals():
    ring = scan(GROUND)
    ring = ring[np.abs(np.arctan2(ring[:, 2], np.hypot(ring[:, 0], ring[:, 1])) - ELEVATIONS_RAD[3]) < 0.003]
    alone, cloud = (prepared(ring, voxel_m=VOXEL_M, origin=o) for o in (None, np.zeros(3)))
    assert len(cloud.points) > 50
    assert np.array_equal(cloud.normals, alone.normals)


def test_points_that_all_lie_on_a_beam_have_no_normal():
    beam = np.outer(np.arange(1.0, 41.0), [1.0, 2.0, 0.5])
    assert not prepared(beam, voxel_m=VOXEL_M, origin=np.zeros(3)).normals.any()
