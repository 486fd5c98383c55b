"""Differences of two runs' maps: what appeared, what vanished, and what was not looked at again.

Only what both runs looked at is compared: a surface has appeared where the earlier run's rays passed free
space, and vanished where the later run's did. Weak evidence, one hit or a few misses, is no change. They are
written as clouds of what changed, a list of it, and a picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.clusters import cluster_numbers
from mapper.core.errors import ConfigError
from mapper.core.geometry import Array, Points, Transform, apply, inverse
from mapper.export.figures import APPEARED, NOT_SEEN_AGAIN, VANISHED, Rgb
from mapper.export.mesh_files import write_ply
from mapper.export.picture import write_layers
from mapper.merging.world_poses import Placed
from mapper.octree.map import OctreeMap
from mapper.octree.sparse_grid import log_odds
from mapper.run.folder import Run
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, atomic_folder, write_json

_TOLERANCE_VOXELS, _MOST_TOLERANCE_VOXELS = 2.0, 20
_MIN_VOXELS = 8
_SURE_HITS, _SURE_MISSES = 2, 4
_LEAST_SAME = 0.8
"""Most of a place stays as it is from one session to the next."""
_NEIGHBOUR_VOXELS = 1.8
"""Voxels that share a corner belong to one cluster: √3, and the rounding of a turned grid."""

_PICTURE = "diff.png"
_FOLDER = FolderKind(
    "a comparison of two runs",
    manifest_keys=frozenset({"before", "after", "T_before_after"}),
    files=frozenset({_PICTURE, "*.ply"}),
)


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """Connected voxels that have appeared or vanished.

    Attributes:
        centres_world: (N, 3) centres of its voxels, metres, in the earlier run's world.
    """

    centres_world: Points

    @property
    def centre_world(self) -> Array:
        """(3,) middle of its box, metres."""
        middle: Array = 0.5 * (self.centres_world.min(axis=0) + self.centres_world.max(axis=0))
        return middle

    def size_m(self, resolution_m: float) -> Array:
        """Return the (3,) edges of its box along x, y and z."""
        size: Array = np.ptp(self.centres_world, axis=0) + resolution_m
        return size


@dataclass(frozen=True, slots=True, eq=False)
class Differences:
    """Differences of a later map from an earlier one, in the earlier one's world.

    Attributes:
        appeared: Clusters of voxels that stand in space that was free before, the largest first.
        vanished: Clusters of voxels that stood in space that is free now, the largest first.
        not_seen_again: (N, 3) centres of occupied voxels of the earlier map that the later run did not look
            at, metres.
        newly_seen: (N, 3) the same of the later map, where the earlier run did not look.
        same: Number of occupied voxels of the earlier map that are occupied still.
        small: Number of voxels in clusters too small to be listed.
        T_before_after: (4, 4) pose of the later run's world in the earlier one's.
    """

    appeared: Sequence[Cluster]
    vanished: Sequence[Cluster]
    not_seen_again: Points
    newly_seen: Points
    same: int
    small: int
    T_before_after: Transform

    @property
    def seen_again(self) -> int:
        """Number of voxels of the earlier map that the later run looked at: the same, or vanished."""
        return self.same + sum(len(cluster.centres_world) for cluster in self.vanished)

    @property
    def warning(self) -> str:
        """Reason why the runs may not lie as they were placed; empty if there is none."""
        if self.same >= _LEAST_SAME * self.seen_again:
            return ""
        return (
            f"only {self.same} of {self.seen_again} voxels seen again are the same; do the runs lie in one "
            "world? --place auto finds out"
        )


def differences_of(
    before: Placed, after: Placed, *, tolerance_m: float | None = None, min_voxels: int = _MIN_VOXELS
) -> Differences:
    """Compare the maps of two runs.

    Args:
        before: The earlier run; the answer is in its world.
        after: The later run.
        tolerance_m: A surface this near to one of the other map is the same; None is two voxels.
        min_voxels: Smaller clusters are counted, not listed.

    Raises:
        ConfigError: The maps have different resolutions, or the tolerance is more than 20 voxels.
    """
    old, new = (placed.run.octree for placed in (before, after))
    if old.resolution_m != new.resolution_m:
        raise ConfigError(
            f"{after.run.path}: octree.resolution_m is {new.resolution_m:g}, but {old.resolution_m:g} in "
            f"{before.run.path}; make its maps again with mapper fuse {after.run.path} "
            f"--set octree.resolution_m={old.resolution_m:g}"
        )
    T_before_after = inverse(before.T_map_world) @ after.T_map_world
    tolerance_m = _TOLERANCE_VOXELS * old.resolution_m if tolerance_m is None else tolerance_m
    if not 0.0 <= tolerance_m <= (most_m := _MOST_TOLERANCE_VOXELS * old.resolution_m):
        raise ConfigError(f"tolerance_m is {tolerance_m:g} m; want 0 to {most_m:g}; 0.05 is 5 cm")
    return compare_maps(old, new, T_before_after, tolerance_m=tolerance_m, min_voxels=min_voxels)


def compare_maps(
    before: OctreeMap, after: OctreeMap, T_before_after: Transform, *, tolerance_m: float, min_voxels: int
) -> Differences:
    """Compare two maps of one resolution; see :func:`differences_of`.

    Args:
        before: The earlier map; the answer is in its world.
        after: The later map.
        T_before_after: (4, 4) pose of the later map's world in the earlier one's.
        tolerance_m: A surface this near to one of the other map is the same.
        min_voxels: Smaller clusters are counted, not listed.
    """
    old, new = _surely_occupied(before), apply(T_before_after, _surely_occupied(after))
    old_is = _compare(old, after, inverse(T_before_after), tolerance_m)
    new_is = _compare(new, before, np.eye(4), tolerance_m)
    appeared, few_new = _clusters(new[new_is.free], before.resolution_m, min_voxels)
    vanished, few_old = _clusters(old[old_is.free], before.resolution_m, min_voxels)
    return Differences(
        appeared=appeared,
        vanished=vanished,
        not_seen_again=old[old_is.unknown],
        newly_seen=new[new_is.unknown],
        same=int(np.count_nonzero(old_is.occupied)),
        small=few_new + few_old,
        T_before_after=T_before_after,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """(N,) masks of surfaces by what the other map says of their place; none of them: weakly free."""

    occupied: NDArray[np.bool_]
    free: NDArray[np.bool_]
    unknown: NDArray[np.bool_]


def _surely_occupied(octree: OctreeMap) -> Points:
    leaves = octree.leaves()
    least = _SURE_HITS * log_odds(octree.config.hit_probability)
    return leaves.centres_world[leaves.log_odds >= max(least, octree.occupied_log_odds)]


def _compare(centres: Points, other: OctreeMap, T_other_centres: Transform, tolerance_m: float) -> _Compared:
    points = apply(T_other_centres, centres)
    values = other.log_odds_at(points)
    occupied = other.are_near_occupied(points, max_distance_m=tolerance_m)
    config = other.config
    most = max(_SURE_MISSES * log_odds(config.miss_probability), log_odds(config.clamp_min_probability))
    return _Compared(occupied, free=~occupied & (values <= most), unknown=~occupied & np.isnan(values))


def _clusters(centres: Points, resolution_m: float, min_voxels: int) -> tuple[list[Cluster], int]:
    """Return the clusters, the largest first, and how many voxels are in smaller ones."""
    cluster_of = cluster_numbers(centres, _NEIGHBOUR_VOXELS * resolution_m)
    sizes = np.bincount(cluster_of)
    large = np.flatnonzero(sizes >= min_voxels)
    order = large[np.argsort(-sizes[large], kind="stable")]
    clusters = [Cluster(centres[cluster_of == number]) for number in order]
    return clusters, int(sizes.sum() - sizes[large].sum())


def write_differences(
    out: Path, found: Differences, before: Run, after: Run, *, placed: str, overwrite: bool = False
) -> None:
    """Write a list (``manifest.json``), a picture (``diff.png``) and a cloud of voxels for each kind.

    Args:
        out: Folder to create.
        found: The differences.
        before: The earlier run, whose slice lies below the picture.
        after: The later run.
        placed: Source of the later run's pose, in a few words.
        overwrite: Replace a folder of such files.

    Raises:
        RunError: OUT is there already.
    """
    layers: dict[str, tuple[Points, Rgb]] = {
        "not seen again": (found.not_seen_again, NOT_SEEN_AGAIN),
        "vanished": (_join(found.vanished), VANISHED),
        "appeared": (_join(found.appeared), APPEARED),
    }
    resolution_m = before.config.octree.resolution_m
    with atomic_folder(out, _FOLDER, overwrite=overwrite) as folder:
        for name, (centres, color) in layers.items():
            colors = np.tile(np.array(color, np.uint8), (len(centres), 1))
            write_ply(folder / f"{name.replace(' ', '_')}.ply", centres.astype(np.float32), colors)
        write_layers(
            folder / _PICTURE,
            grid=before.slice,
            layers=layers,
            title=f"{before.path.resolve().name} → {after.path.resolve().name}",
            lines=[summary(found), placed],
        )
        record = {
            "before": str(before.path.resolve()),
            "after": str(after.path.resolve()),
            "T_before_after": found.T_before_after.tolist(),
            "placed": placed,
            "appeared": [_describe(cluster, resolution_m) for cluster in found.appeared],
            "vanished": [_describe(cluster, resolution_m) for cluster in found.vanished],
            "voxels": {
                "same": found.same,
                "not_seen_again": len(found.not_seen_again),
                "newly_seen": len(found.newly_seen),
                "in_small_clusters": found.small,
            },
        }
        write_json(folder / MANIFEST_NAME, record)


def summary(found: Differences) -> str:
    """Return the counts in one line."""
    return (
        f"{len(found.appeared)} appeared, {len(found.vanished)} vanished; {found.same} of {found.seen_again} "
        f"voxels seen again are the same, {len(found.not_seen_again)} were not seen again"
    )


def _join(clusters: Sequence[Cluster]) -> Points:
    return np.concatenate([np.empty((0, 3)), *(cluster.centres_world for cluster in clusters)])


def _describe(cluster: Cluster, resolution_m: float) -> dict[str, object]:
    return {
        "centre_m": np.round(cluster.centre_world, 3).tolist(),
        "size_m": np.round(cluster.size_m(resolution_m), 3).tolist(),
        "voxels": len(cluster.centres_world),
    }
