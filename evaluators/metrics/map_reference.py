"""Reference of a map: a cloud, another map, or the world of a synthetic log."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points, Transform, apply, inverse
from mapper.core.voxel_grid import thin
from mapper.evaluators.metrics.occupancy import (
    LogOddsAt,
    OccupancyCheck,
    SignedDistance,
    assess_by_distance,
    assess_by_points,
)
from mapper.octree.map import OctreeMap, read_octree
from mapper.run.files import OCTREE_MAP
from mapper.simulation import read_scene
from mapper.simulation.config import LidarSynthConfig
from mapper.simulation.lidar import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.solids import Shape
from mapper.sources.cloud_files import ENDINGS, read_cloud

MAP_ENDINGS = (".bt", ".ot", ".octree")
_WANTED = (
    f"want a cloud ({' '.join(ENDINGS)}), an octree ({' '.join(MAP_ENDINGS)}), a run, or a synthetic log"
)
_MOST_POINTS = 50_000_000  # 1.2 GB
_THINNED_RATIO = 0.25  # of a voxel: a cloud so thin still fills every voxel that it filled


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """A reference in its own frame.

    Attributes:
        name: Description for a reader.
        points: (N, 3) metres on its surfaces, no two in a quarter of the map's voxels; None for a world that
            is known exactly.
        signed_distance_m: Signed distance in a world that is known exactly, else None.
        log_odds_at: Log-odds in a map, else None.
        in_truth: It is in the world of the log's truth.
    """

    name: str
    points: Points | None = None
    signed_distance_m: SignedDistance | None = None
    log_odds_at: LogOddsAt | None = None
    in_truth: bool = False


def read_reference(path: Path, *, voxel_m: float) -> Reference:
    """Return the reference of a file, of another run's folder, or of a synthetic log's.

    Args:
        path: A cloud, an octree, a ``scene.json``, or a folder with one of the latter two.
        voxel_m: Edge of the voxels of the map that it is for.

    Raises:
        DataError: It is nothing of the kind.
        MapperError: The file cannot be read or is damaged.
    """
    if not path.exists():
        raise DataError(f"{path}: no such reference for a map; {_WANTED}")
    if path.is_dir():
        inside = [path / name for name in (OCTREE_MAP, SCENE) if (path / name).is_file()]
        if not inside:
            raise DataError(f"{path}: has neither {OCTREE_MAP} nor {SCENE}; {_WANTED}")
        path = inside[0]
    ending = path.suffix.lower()
    if ending == ".json":
        return Reference("synthetic world", signed_distance_m=scene_distance(path), in_truth=True)
    if ending in MAP_ENDINGS:
        return _octree(read_octree(path), voxel_m)
    if ending in ENDINGS:
        points = read_cloud(path).points
        return Reference("cloud", points=points[thin(points, _THINNED_RATIO * voxel_m)].astype(np.float64))
    raise DataError(f"{path}: not a reference for a map; {_WANTED}")


def check_occupancy(
    octree: OctreeMap, reference: Reference, T_map_reference: Transform, *, voxels: int
) -> OccupancyCheck:
    """Return which voxels of a map are right.

    Raises:
        DataError: The two share no known surface.
    """
    T_reference_map = inverse(T_map_reference)
    if (distance_m := reference.signed_distance_m) is not None:
        return assess_by_distance(
            octree, lambda points_map: distance_m(apply(T_reference_map, points_map)), voxels=voxels
        )
    assert reference.points is not None
    log_odds_at = reference.log_odds_at
    return assess_by_points(
        octree,
        apply(T_map_reference, reference.points),
        log_odds_at=None
        if log_odds_at is None
        else lambda points_map: log_odds_at(apply(T_reference_map, points_map)),
        voxels=voxels,
    )


def _octree(octree: OctreeMap, voxel_m: float) -> Reference:
    centres = octree.occupied()
    if not len(centres):
        raise DataError("reference: no voxel of the map is occupied, so it has no surface")
    # A large voxel is as many points as it has of the other map's voxels.
    pieces = max(1, int(np.ceil(octree.resolution_m / voxel_m)))
    if len(centres) * pieces**3 > _MOST_POINTS:
        raise DataError(
            f"reference: {len(centres)} voxels of {octree.resolution_m:g} m are too coarse for a map of "
            f"{voxel_m:g} m: {len(centres) * pieces**3} points, over {_MOST_POINTS}; compare a coarser map"
        )
    steps = ((np.arange(pieces) + 0.5) / pieces - 0.5) * octree.resolution_m
    offsets = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    points = (centres[:, None] + offsets).reshape(-1, 3)
    return Reference("octree", points=points, log_odds_at=octree.log_odds_at)


SCENE = "scene.json"
_BATCH = 4096  # points at once; those of a map lie together, so that most solids are out of reach


def scene_distance(path: Path) -> SignedDistance:
    """Return the signed distance to the world of a synthetic log, in the frame of its truth.

    What moved in it is no part of that world.

    Args:
        path: The log's ``scene.json``.

    Raises:
        DataError: It is not one that ``mapper synth`` wrote.
    """
    try:
        scene = json.loads(path.read_text(encoding="utf-8"))
        outdoors = LidarSynthConfig(**scene["config"]) if "solids" in scene else None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):  # pydantic's errors are ValueErrors
        raise DataError(f"{path}: not a scene of `mapper synth`: write the log again") from None
    if outdoors is None:
        return read_scene(path).signed_distance_m
    world = make_outdoor_scene(outdoors)
    return lambda points_world: outdoor_distance_m(world, points_world)


def outdoor_distance_m(scene: OutdoorScene, points_world: Points) -> Array:
    """Return how far (N, 3) points are from ground and solids, metres, negative inside.

    It is exact for boxes and round cylinders, and to first order near all other surfaces.
    """
    distances_m = np.empty(len(points_world))
    for first in range(0, len(points_world), _BATCH):
        batch = slice(first, first + _BATCH)
        distances_m[batch] = _distances_m(scene, points_world[batch])
    return distances_m


def _distances_m(scene: OutdoorScene, points: Points) -> Array:
    above_m = points[:, 2] - scene.ground.height_m(points[:, :2])
    distances_m: Array = above_m * scene.ground.normals(points[:, :2])[:, 2]
    low, high = points.min(axis=0), points.max(axis=0)
    hulls = scene.solids.hulls
    for center, half, yaw, shape in zip(
        hulls.centers_world, hulls.half_sizes_m, hulls.yaws_rad, scene.solids.shapes, strict=True
    ):
        radius_m = float(np.linalg.norm(half))
        gap_m = float(np.linalg.norm(np.maximum(np.maximum(low - center, center - high), 0.0))) - radius_m
        if gap_m > max(float(distances_m.max()), 0.0):
            continue
        offsets = points - center
        near = np.flatnonzero(np.linalg.norm(offsets, axis=1) - radius_m <= np.maximum(distances_m, 0.0))
        if len(near):
            cosine, sine = np.cos(yaw), np.sin(yaw)
            x, y, z = offsets[near].T
            own = np.column_stack([cosine * x + sine * y, cosine * y - sine * x, z])
            distances_m[near] = np.minimum(distances_m[near], _of_solid(own, half, Shape(shape)))
    return distances_m


def _of_solid(points: Points, half: Array, shape: Shape) -> Array:
    if shape is Shape.ELLIPSOID:
        return _of_ellipse(points, half)
    beyond = np.abs(points) - half
    if shape is Shape.CYLINDER:
        beyond = np.column_stack([_of_ellipse(points[:, :2], half[:2]), beyond[:, 2]])
    distances: Array = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    return distances


def _of_ellipse(points: Array, half: Array) -> Array:
    """Return the distances of (N, D) points from an ellipse or ellipsoid: exact if it is round."""
    scaled = np.linalg.norm(points / half, axis=1)
    slope = np.linalg.norm(points / half**2, axis=1)
    middle = slope < 1e-12
    distances: Array = np.where(middle, -half.min(), scaled * (scaled - 1.0) / np.where(middle, 1.0, slope))
    return distances
