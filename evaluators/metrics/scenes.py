"""Distances of points from the solids of a synthetic world, whose every surface is known."""

import json
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points
from mapper.evaluators.metrics.occupancy import SignedDistance
from mapper.simulation import read_scene
from mapper.simulation.config import LidarSynthConfig
from mapper.simulation.lidar import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.solids import Shape

SCENE = "scene.json"
_BATCH = 1 << 12  # points at once; those of a map lie together, so that most solids are out of reach


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
    """Return the distances of (N, 3) points from a solid, in its own axes."""
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
