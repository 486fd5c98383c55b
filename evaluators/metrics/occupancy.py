"""Occupancy check: how right a map's voxels are by a world known exactly, a cloud, or another map."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points
from mapper.core.voxel_grid import DIAGONAL
from mapper.evaluators.metrics.metric import Metric
from mapper.octree.keys import KEY_COUNT, KEY_ZERO
from mapper.octree.map import OctreeMap
from mapper.octree.queries import Leaves

SignedDistance = Callable[[Points], Array]
"""Maps (N, 3) points in metres to their distances from the nearest surface, negative inside solids."""

LogOddsAt = Callable[[Points], NDArray[np.float32]]
"""Maps (N, 3) points in metres to log-odds, NaN where nothing is known."""

Keys = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyCheck:
    """Every voxel that can be assessed, and whether it is right.

    Attributes:
        occupied: (O, 3) keys of the map's occupied voxels where the reference is known.
        right: (O,) whether the reference has a surface within the tolerance.
        surface: (S, 3) keys of the voxels that the reference's surfaces pass through.
        found: (S,) whether the map has an occupied voxel within the tolerance.
        seen: (S,) found, or at least known in the map: an unknown surface is not missed.
        free_right: (F,) for free voxels of the map, known in the reference, whether it is not solid there.
        open_free: (G,) for voxels of the reference's open space, known in the map, whether they are free.
        voxels: The tolerance.
        resolution_m: Edge of a voxel.
    """

    occupied: Keys
    right: Mask
    surface: Keys
    found: Mask
    seen: Mask
    free_right: Mask
    open_free: Mask
    voxels: int
    resolution_m: float

    def __post_init__(self) -> None:
        if not len(self.occupied) or not self.seen.any():
            raise DataError(
                "occupancy: the map and the reference share no known surface; are both in one frame?"
            )

    @property
    def centres_world(self) -> tuple[Points, Points, Points]:
        """Centres of the occupied voxels that are right, of those that are not, and of surfaces not found."""
        missing = self.surface[self.seen & ~self.found]
        return (
            self._centres(self.occupied[self.right]),
            self._centres(self.occupied[~self.right]),
            self._centres(missing),
        )

    def _centres(self, keys: Keys) -> Points:
        return (keys.astype(np.float64) - (KEY_ZERO - 0.5)) * self.resolution_m

    def seen_at(self, points_world: Points) -> Mask:
        """Return (N,) whether the map saw the voxel of each of (N, 3) points on the reference's surfaces."""
        return _near(_lattice(points_world, self.resolution_m), self.surface[self.seen], voxels=0)


def assess_by_distance(
    octree: OctreeMap, signed_distance_m: SignedDistance, *, voxels: int = 1
) -> OccupancyCheck:
    """Check a map by a world whose solids are known exactly.

    An occupied voxel is right if its middle is within the tolerance, and half a voxel, of a solid; a free one
    if it is as near to free space. Surfaces are those that pass through the middle half of a voxel which the
    map knows; open space is what has no solid within the tolerance.

    Args:
        octree: The map, in the frame of the truth.
        signed_distance_m: The truth.
        voxels: The tolerance.

    Raises:
        DataError: The map is empty, or has no surface.
    """
    leaves, occupied = _known(octree)
    edge_m = leaves.resolution_m
    reach_m = (voxels + 0.5) * edge_m
    distance_m = signed_distance_m(leaves.centres_world)
    keys = leaves.keys.astype(np.int64)
    surface = keys[np.abs(distance_m) <= 0.25 * edge_m]
    return OccupancyCheck(
        occupied=keys[occupied],
        right=distance_m[occupied] <= reach_m,
        surface=surface,
        found=_near(surface, keys[occupied], voxels=voxels),
        seen=np.ones(len(surface), np.bool_),
        free_right=distance_m[~occupied] >= -reach_m,
        open_free=~occupied[distance_m > reach_m * DIAGONAL],
        voxels=voxels,
        resolution_m=edge_m,
    )


def assess_by_points(
    octree: OctreeMap, points_world: Points, *, log_odds_at: LogOddsAt | None = None, voxels: int = 1
) -> OccupancyCheck:
    """Check a map by points on a reference's surfaces, and by its free space where that is known.

    Tolerances are whole voxels along each axis. Free voxels are right unless the reference is solid there and
    the map has no surface within the tolerance; open space is what is free with no surface so near.

    Args:
        octree: The map.
        points_world: (N, 3) metres, in the map's world, so dense that no voxel of a surface is left out.
        log_odds_at: Log-odds of the reference in the map's world; None if only its surfaces are known, so
            that every occupied voxel is assessed and no free one.
        voxels: The tolerance.

    Raises:
        DataError: The map is empty, or has none of the surfaces.
    """
    leaves, occupied = _known(octree)
    keys = leaves.keys.astype(np.int64)
    surface = _keys_of(points_world, leaves.resolution_m)
    near_surface = _near(keys, surface, voxels=voxels)
    found = _near(surface, keys[occupied], voxels=voxels)
    assessed, free_right, open_free = occupied, np.empty(0, np.bool_), np.empty(0, np.bool_)
    if log_odds_at is not None:
        values = log_odds_at(leaves.centres_world)
        known, solid = ~np.isnan(values), values >= octree.occupied_log_odds
        assessed = occupied & (known | near_surface)
        near_ours = _near(keys, keys[occupied], voxels=voxels)
        free_right = (~solid | near_ours)[known & ~occupied]
        open_free = ~occupied[known & ~near_surface]
    return OccupancyCheck(
        occupied=keys[assessed],
        right=near_surface[assessed],
        surface=surface,
        found=found,
        seen=found | _near(surface, keys, voxels=0),
        free_right=free_right,
        open_free=open_free,
        voxels=voxels,
        resolution_m=leaves.resolution_m,
    )


def check_metrics(check: OccupancyCheck) -> list[Metric]:
    """Return precision, recall and F-score of occupied space, and of free space what is known of it.

    The F-score is their harmonic mean (Knapitsch et al. 2017).
    """
    within = f"within {check.voxels} voxel{'s' if check.voxels != 1 else ''}"
    precision, recall = float(check.right.mean()), float(check.found[check.seen].mean())
    metrics = [
        Metric("occupied precision", precision, "ratio", within),
        Metric("occupied recall where the map looked", recall, "ratio", within),
        Metric(
            "occupied F-score", 2.0 * precision * recall / max(precision + recall, 1e-300), "ratio", within
        ),
    ]
    if not check.seen.all():
        whole = float(check.found.mean())
        metrics.append(Metric("occupied recall of the whole reference", whole, "ratio", within))
    if len(check.free_right) and len(check.open_free):
        metrics += [
            Metric("free precision", float(check.free_right.mean()), "ratio", within),
            Metric("free recall", float(check.open_free.mean()), "ratio", within),
        ]
    return metrics


def _known(octree: OctreeMap) -> tuple[Leaves, Mask]:
    leaves = octree.leaves()
    return leaves, leaves.log_odds >= octree.occupied_log_odds


def _keys_of(points_world: Points, resolution_m: float) -> Keys:
    """Return the (K, 3) distinct keys of points; those beyond the range of keys are left out."""
    keys = _lattice(points_world, resolution_m)
    keys = keys[((keys >= 0) & (keys < KEY_COUNT)).all(axis=1)]
    _, first = np.unique(keys @ [1, KEY_COUNT, KEY_COUNT**2], return_index=True)
    return keys[first]


def _lattice(points_world: Points, resolution_m: float) -> Keys:
    return np.floor(points_world / resolution_m).astype(np.int64) + KEY_ZERO


def _near(keys: Keys, others: Keys, *, voxels: int) -> Mask:
    """Return for each of (N, 3) keys whether another is at most a number of steps away along each axis."""
    if not len(others):
        return np.zeros(len(keys), np.bool_)
    steps, _ = cKDTree(others).query(keys, p=np.inf, distance_upper_bound=voxels + 0.5)
    near: Mask = np.isfinite(steps)
    return near
