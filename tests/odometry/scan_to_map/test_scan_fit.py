"""Points for the free-space check: where rays beside theirs hit the same surface."""

import numpy as np

from mapper.core.frames import Scan
from mapper.odometry.scan_to_map.scan_fit import described
from tests.support.room_scans import keyframe

HEIGHT_M = 1.8
OFF_RAD = 1.5 * np.radians(1.0)


def test_points_of_the_ground_lie_where_rays_above_theirs_hit_it():
    below, azimuths = np.radians(np.arange(4.0, 20.0, 0.25)), np.radians(np.arange(0.0, 360.0, 0.5))
    below_rad, azimuth = (grid.ravel() for grid in np.meshgrid(below, azimuths))
    away_m = HEIGHT_M / np.tan(below_rad)
    points = np.column_stack(
        [away_m * np.cos(azimuth), away_m * np.sin(azimuth), np.full(len(away_m), -HEIGHT_M)]
    )
    deskewed = keyframe(Scan(0, points.astype(np.float32)), voxel_m=0.4).deskewed

    checked = described(deskewed).points_level
    ranges_m = np.linalg.norm(checked, axis=1)
    angles = np.arcsin(-checked[:, 2] / ranges_m)
    expected_m = HEIGHT_M / np.sin(angles - OFF_RAD)
    assert len(checked) > 500
    assert np.median(np.abs(ranges_m / expected_m - 1.0)) < 0.01
    assert np.quantile(np.abs(ranges_m / expected_m - 1.0), 0.95) < 0.03
