"""Quality of a run's map: its octree and its cloud compared with a reference."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import Points32
from mapper.core.geometry import Transform, apply, inverse, mean_rotation, transform
from mapper.core.trajectory import with_rotations
from mapper.evaluators.metrics.map_reference import Reference, check_occupancy
from mapper.evaluators.metrics.metric import Metric
from mapper.evaluators.metrics.occupancy import OccupancyCheck, check_metrics
from mapper.evaluators.metrics.trajectory_errors import associate
from mapper.registration.kd_tree import kd_tree
from mapper.registration.pair_refinement import refined_motion
from mapper.registration.surfaces import prepared
from mapper.run import files
from mapper.run.folder import Run
from mapper.sources.cloud_files import read_cloud


@dataclass(frozen=True, slots=True)
class CloudDistance:
    """Distances of the points p of a cloud P to the nearest of a cloud Q: not the same the other way round.

    Attributes:
        mhd_m: Modified Hausdorff distance, their mean.
        mpd_m: Their median, which objects that moved between the two scans do not disturb.
    """

    mhd_m: float
    mpd_m: float


class DistanceTo:
    """Distances from one cloud, whose search tree is built once."""

    def __init__(self, points_target: Points32) -> None:
        """Index the cloud Q, (N, 3) metres.

        Raises:
            DataError: It is empty.
        """
        self._tree = kd_tree(points_target)

    def of(self, points_source: Points32, T_target_source: Transform) -> CloudDistance:
        """Return the distance of the cloud P, (M, 3) metres in its own frame, from Q under a motion.

        Raises:
            DataError: It is empty.
        """
        if len(points_source) == 0:
            raise DataError("cloud distance: the source has no points")
        _, distances_m = self._tree.nearest(apply(T_target_source, points_source.astype(np.float64)))
        return CloudDistance(float(distances_m.mean()), float(np.median(distances_m)))


_PAIR_VOXELS = 3.0
"""Largest distance between the points of a pair while a reference is registered."""

World = Literal["truth", "map"]
"""World of a reference: that of the log's truth, or the run's own, which is levelled."""


@dataclass(frozen=True, slots=True, eq=False)
class MapQuality:
    """Comparison of a map with a reference.

    Attributes:
        metrics: Every number; the first names the alignment of the reference.
        check: The voxels that they come from.
    """

    metrics: tuple[Metric, ...]
    check: OccupancyCheck


def map_quality(
    run: Run, reference: Reference, *, world: World | None, voxels: int, register: bool
) -> MapQuality:
    """Return how right a run's octree and cloud are.

    Args:
        run: A finished run.
        reference: Reference that it is compared with.
        world: World of the reference; None is the truth's for the world of a synthetic log, else the
            run's own.
        voxels: Largest distance between matching surfaces, in voxels.
        register: Refine the alignment of the reference by point-to-plane ICP with the run's cloud.

    Raises:
        DataError: The log has no truth to place the reference by, the two share no known surface, or there
            are no points to register.
    """
    world = world or ("truth" if reference.in_truth else "map")
    cloud = read_cloud(run.file(files.CLOUD), scale=1.0).points
    T_map_reference = _aligned_by_truth(run) if world == "truth" else np.eye(4)
    how = "by the truth's poses" if world == "truth" else "in the run's own world"
    if register:
        refined = _registered(reference, cloud, T_map_reference, voxel_m=run.octree.resolution_m)
        moved_m = float(np.linalg.norm((inverse(T_map_reference) @ refined)[:3, 3]))
        T_map_reference, how = refined, f"{how}, then registered"
    check = check_occupancy(run.octree, reference, T_map_reference, voxels=voxels)
    metrics = [
        Metric(f"map compared with the {reference.name}", len(check.occupied), "voxels", f"placed {how}"),
        *([Metric("registration moved it by", moved_m, "m")] if register else []),
        *check_metrics(check),
        *_distances(reference, check, cloud, T_map_reference),
    ]
    return MapQuality(tuple(metrics), check)


def _aligned_by_truth(run: Run) -> Transform:
    """Return T_map_truth, by all poses that have a true one.

    Positions alone would leave a log that hardly leaves its place to turn about it.
    """
    truth = with_rotations(run.truth)
    if truth is None:
        raise DataError(f"{run.path}: its log has no true poses to lay a reference by; pass --map-world map")
    matched = associate(run.trajectory, truth, names=(str(run.path), "its truth"))
    R_map, R_truth = matched.T_map_body[:, :3, :3], matched.T_truth_body[:, :3, :3]
    R = mean_rotation(R_map @ np.swapaxes(R_truth, 1, 2), np.ones(len(matched)))
    return transform(R, (matched.T_map_body[:, :3, 3] - matched.T_truth_body[:, :3, 3] @ R.T).mean(axis=0))


def _registered(
    reference: Reference, cloud: Points32, T_map_reference: Transform, *, voxel_m: float
) -> Transform:
    if reference.points is None:
        raise DataError("--register: a world that is known exactly has no points to register")
    found = refined_motion(
        prepared(cloud, voxel_m=voxel_m),
        prepared(reference.points, voxel_m=voxel_m),
        T_map_reference,
        kind="plane-icp",
        pair_distances_m=(_PAIR_VOXELS * voxel_m,),
    )
    if isinstance(found, str):
        raise DataError(f"--register: {found}")
    return found


def _distances(
    reference: Reference, check: OccupancyCheck, cloud: Points32, T_map_reference: Transform
) -> list[Metric]:
    """Return modified Hausdorff and median distances in both directions; from an exact world in none."""
    T_reference_map = inverse(T_map_reference)
    if reference.signed_distance_m is not None:
        distances_m = np.abs(reference.signed_distance_m(apply(T_reference_map, cloud.astype(np.float64))))
        there = CloudDistance(float(distances_m.mean()), float(np.median(distances_m)))
        return _both(there, "cloud → reference")
    assert reference.points is not None
    points = reference.points.astype(np.float32)
    there = DistanceTo(points).of(cloud, T_reference_map)
    seen = points[check.seen_at(apply(T_map_reference, reference.points))]
    back = DistanceTo(cloud).of(seen, T_map_reference)
    return _both(there, "cloud → reference") + _both(back, "reference → cloud where the map looked")


def _both(distance: CloudDistance, way: str) -> list[Metric]:
    return [Metric("MHD", distance.mhd_m, "m", way), Metric("MPD", distance.mpd_m, "m", way)]
