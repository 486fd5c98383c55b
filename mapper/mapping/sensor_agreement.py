"""Agreement of sensors beside the tracked one with it: whether their points lie on the surfaces it saw."""

from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, apply, inverse, log, spread_indices
from mapper.core.running_median import SIGMAS_PER_MAD
from mapper.core.trajectory import Trajectory
from mapper.mapping.placed_frames import PlacedFrame, placed_frames, sensor_paths
from mapper.registration.config import GicpConfig
from mapper.registration.icp import cloud_of, refined
from mapper.registration.pair_refinement import measured_agreement
from mapper.sources.base import Log

_LOOKED_AT, _FEWEST = 12, 5
"""Scans of a sensor, spread over the log, and those that have to overlap for a judgement."""
_LEAST_SHARE = 0.15
"""Share of a scan's points that agree where it overlaps: sensors that look elsewhere overlap little."""
_AROUND, _NEAR_VOXELS = 7, 60.0
"""Tracked scans to which one is registered, spread over those nearby: a sensor that looks back sees what one
that looks forward saw before."""
_LEAST_M, _LEAST_RAD = 0.15, np.radians(1.5)
_LEAST_SIGMAS = 5.0
_TIMES_BETTER = 1.25
"""Points that agree, in those at the stated mounting: 1.0 to 1.05 of right ones even where a motion is open,
as along tunnels, and 1.4 to 4 of those 0.3 m off."""


def mounting_warnings(source: Log, trajectory: Trajectory, *, voxel_m: float) -> list[str]:
    """Return which sensors have all their points beside the tracked LiDAR's surfaces, in a sentence for each.

    Scans of each are registered to the tracked ones taken nearby, and the median motion counts. Sensors whose
    views do not overlap, 2D lasers, and sensors beside a tracked camera are not judged.

    Args:
        source: The log of a 3D LiDAR, with the sensors beside it.
        trajectory: Final poses of the tracked sensor.
        voxel_m: Edge of the voxels to which scans are reduced, small enough for the surroundings.
    """
    (_, path), *others = sensor_paths(source, trajectory)
    tracked = list(placed_frames(source, path))
    warnings = []
    for other, other_path in others:
        fits = [] if other.sensor == "lidar-2d" else list(_fits(tracked, other, other_path, voxel_m))
        if len(fits) < _FEWEST:
            continue
        offsets, shares = np.split(np.array(fits), [6], axis=1)
        median, (stated, found) = np.median(offsets, axis=0), np.median(shares, axis=0)
        sigma = SIGMAS_PER_MAD * np.median(np.abs(offsets - median), axis=0) / np.sqrt(len(offsets))
        sure = np.where(np.abs(median) > _LEAST_SIGMAS * sigma, median, 0.0)
        turned_rad, moved_m = (float(np.linalg.norm(part)) for part in (sure[:3], sure[3:]))
        if found > _TIMES_BETTER * stated and (turned_rad > _LEAST_RAD or moved_m > _LEAST_M):
            warnings.append(
                f"{other.name}: {found:.0%} of its points lie on the surfaces of the tracked sensor if they "
                f"are moved by {moved_m:.2f} m and turned by {np.degrees(turned_rad):.1f}°, and {stated:.0%} "
                f"if not (medians of {len(fits)} scans): is its place in tf right, and its clock?"
            )
    return warnings


def _fits(tracked: list[PlacedFrame], other: Log, path: Trajectory, voxel_m: float) -> Iterator[Array]:
    """Yield what ``_fit`` finds for scans of another sensor, in its own frame."""
    positions = np.array([frame.T_world_body[:3, 3] for frame in tracked]).reshape(-1, 3)
    frames = list(placed_frames(other, path))
    for index in spread_indices(len(frames), _LOOKED_AT).tolist():
        frame = frames[index]
        distances_m = np.linalg.norm(positions - frame.T_world_body[:3, 3], axis=1)
        near = np.flatnonzero(distances_m < _NEAR_VOXELS * voxel_m)
        around = [tracked[k] for k in near[spread_indices(len(near), _AROUND)].tolist()]
        with suppress(FrameError):
            T_sensor_world = inverse(frame.T_world_body)
            points = [
                apply(T_sensor_world @ one.T_world_body, scan.points_body.astype(np.float64))
                for one in around
                for scan in [one.scan_of(one.entry.load())]
            ]
            target = Scan(
                frame.entry.stamp_ns, np.concatenate(points or [np.empty((0, 3))]).astype(np.float32)
            )
            fit = _fit(target, frame.scan_of(frame.entry.load()), GicpConfig(voxel_m=voxel_m))
            if fit[-1] > _LEAST_SHARE:
                yield fit


def _fit(target: Scan, scan: Scan, config: GicpConfig) -> Array:
    """Return (8,) the motion by which a scan fits, and the shares that agree without and with it."""
    clouds = cloud_of(target, config), cloud_of(scan, config)
    T_found = refined(*clouds, np.eye(4), config, kind=config.kind).T_target_source
    shares = [
        measured_agreement(
            *clouds,
            T,
            max_pair_distance_m=config.acceptance.near_voxels * config.voxel_m,
            max_surface_distance_m=config.acceptance.surface_voxels * config.voxel_m,
        )[0].inlier_ratio
        for T in (np.eye(4), T_found)
    ]
    return np.concatenate([*log(T_found), shares])
