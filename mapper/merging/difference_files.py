"""Files of a comparison of two runs: clouds of what changed, a list of it, and a picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapper.core.geometry import Points
from mapper.export.palette import APPEARED, NOT_SEEN_AGAIN, VANISHED, Rgb
from mapper.export.picture import write_layers
from mapper.export.ply import write_ply
from mapper.merging.differences import Cluster, Differences
from mapper.run.folder import Run
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, atomic_folder, write_json

_PICTURE = "diff.png"
_FOLDER = FolderKind(
    "a comparison of two runs",
    manifest_keys=frozenset({"before", "after", "T_before_after"}),
    files=frozenset({_PICTURE, "*.ply"}),
)


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
        "vanished": (_joined(found.vanished), VANISHED),
        "appeared": (_joined(found.appeared), APPEARED),
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
            "appeared": [_described(cluster, resolution_m) for cluster in found.appeared],
            "vanished": [_described(cluster, resolution_m) for cluster in found.vanished],
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


def _joined(clusters: Sequence[Cluster]) -> Points:
    return np.concatenate([np.empty((0, 3)), *(cluster.centres_world for cluster in clusters)])


def _described(cluster: Cluster, resolution_m: float) -> dict[str, object]:
    return {
        "centre_m": np.round(cluster.centre_world, 3).tolist(),
        "size_m": np.round(cluster.size_m(resolution_m), 3).tolist(),
        "voxels": len(cluster.centres_world),
    }
