"""A dense cloud of a scene, as a mobile-mapping drive would leave it."""

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import Scan
from mapper.core.geometry import Points, Transform, apply, inverse, transform
from mapper.simulation.config import IDEAL_LIDAR
from mapper.simulation.lidar.scene import OutdoorScene
from mapper.simulation.lidar.sensor import render_scan

_STATION_STEP_M = 5.0
_MAPPER_HEIGHT_M = 2.2
_HALF_SPAN = 1 << 20
_SCANNER = IDEAL_LIDAR.model_copy(
    update={"rings": 96, "lowest_ring_rad": -0.9, "highest_ring_rad": 0.7, "azimuth_steps": 1200}
)


def sample_map(
    scene: OutdoorScene, T_world_map: Transform, *, spacing_m: float = 0.1, radius_m: float = 60.0
) -> Scan:
    """Return exact points on what a drive along the route sees around a pose, one in each voxel.

    Args:
        scene: The world.
        T_world_map: (4, 4) frame of the cloud; its origin should be near the route.
        spacing_m: Edge of the voxels, metres.
        radius_m: How far from the frame's origin points and stations lie at most.

    Raises:
        DataError: No part of the route is within the radius.
    """
    route = scene.route
    along_m = np.arange(0.0, route.length_m, _STATION_STEP_M)
    stations = route.points(along_m)
    near = np.linalg.norm(stations - T_world_map[:2, 3], axis=1) <= radius_m
    if not near.any():
        raise DataError(
            f"map: no part of the route is within {radius_m} m of {T_world_map[:2, 3]} m; move it nearer"
        )
    heights_m = scene.ground.height_m(stations) + _MAPPER_HEIGHT_M
    T_map_world, rng = inverse(T_world_map), np.random.default_rng(0)
    points_map = np.empty((0, 3))
    for position in np.column_stack([stations, heights_m])[near]:
        T_world_station = transform(np.eye(3), position)
        points_station = render_scan(scene, _SCANNER, T_world_station, rng).points_body.astype(np.float64)
        seen_map = apply(T_map_world @ T_world_station, points_station)
        seen_map = seen_map[np.linalg.norm(seen_map, axis=1) <= radius_m]
        points_map = _one_per_voxel(np.concatenate([points_map, seen_map]), spacing_m)
    return Scan(0, points_map.astype(np.float32))


def _one_per_voxel(points: Points, voxel_m: float) -> Points:
    """Return the first point of each voxel: a mean would leave the surface."""
    x, y, z = np.floor(points / voxel_m).astype(np.int64).T + _HALF_SPAN
    _, first = np.unique((x * 2 * _HALF_SPAN + y) * 2 * _HALF_SPAN + z, return_index=True)
    return points[np.sort(first)]
