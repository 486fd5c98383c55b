"""Quality of a merged map: how far its runs agree, and how right their poses are where truth is known."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError, MapperError
from mapper.evaluators.metrics.evaluate import ALIGNED, ATE_RMSE
from mapper.evaluators.metrics.map_reference import Reference, check_occupancy
from mapper.evaluators.metrics.metric import Metric
from mapper.evaluators.metrics.occupancy import check_metrics
from mapper.evaluators.metrics.trajectory_errors import AlignmentKind, Matched, align, associate, ate
from mapper.merging.merged_map import MergedMap, RunInMap
from mapper.run.folder import open_run


def merged_map_metrics(
    merged: MergedMap, names: Sequence[str], *, alignment: AlignmentKind = "se3"
) -> tuple[list[Metric], list[str]]:
    """Return what a merged map is worth, and notes on runs of which no truth is known.

    With a truth, a run's poses in the map are aligned with it by themselves, which shows bent paths, and
    those of all runs by one alignment, which shows misplaced runs too.

    Args:
        merged: A finished merged map.
        names: Names of its runs, in its order.
        alignment: Alignment of poses with the truth, as of ``assess``.
    """
    manifest = merged.manifest
    metrics = [
        Metric("runs", len(manifest.runs), "runs"),
        Metric("known voxels", manifest.voxels, "voxels"),
        Metric("area seen from above", 1e6 * manifest.area_km2, "m²"),
    ]
    for run, name in zip(manifest.runs, names, strict=True):
        if run.agreement is not None:
            shared = run.shared_voxels / max(run.voxels, 1)
            metrics.append(Metric(f"{name}: voxels that runs before it know", 100.0 * shared, "%"))
            metrics.append(Metric(f"{name}: walls agree there", 100.0 * run.agreement, "%"))
        if run.moved_m > 0.0:
            metrics.append(Metric(f"{name}: bent by at most", run.moved_m, "m"))
    notes = [f"left out: {path}: {why}" for path, why in manifest.left_out.items()]
    known: list[Matched] = []
    for run, name in zip(manifest.runs, names, strict=True):
        matched = _with_truth(merged, run, name)
        if isinstance(matched, str):
            notes.append(matched)
            continue
        known.append(matched)
        metrics.append(Metric(f"{name}: {ATE_RMSE}", _rmse_m(matched, alignment), "m", ALIGNED[alignment]))
    if len(known) > 1:
        together = Matched(
            np.concatenate([matched.stamps_ns for matched in known]),
            np.concatenate([matched.T_map_body for matched in known]),
            np.concatenate([matched.T_truth_body for matched in known]),
        )
        how = f"{len(known)} runs {ALIGNED[alignment]} as one"
        metrics.append(
            Metric(ATE_RMSE, _rmse_m(together, alignment), "m", f"{how}, if their truths share a frame")
        )
    return metrics, notes


def merged_map_quality(merged: MergedMap, reference: Reference, *, voxels: int) -> list[Metric]:
    """Return how right the octree of a merged map is, compared with a reference in the map's world.

    Raises:
        DataError: The reference is in a truth's world, or shares no known surface with the map.
    """
    if reference.in_truth:
        raise DataError(
            f"{merged.path}: a merged map has no truth of its own to lay a {reference.name} by; give a cloud "
            "or an octree in the map's world"
        )
    check = check_occupancy(merged.octree, reference, np.eye(4), voxels=voxels)
    head = Metric(
        f"map compared with the {reference.name}", len(check.occupied), "voxels", "in the map's world"
    )
    return [head, *check_metrics(check)]


def _with_truth(merged: MergedMap, run: RunInMap, name: str) -> Matched | str:
    """Return a run's poses in the map and its truth, or why there are none."""
    try:
        truth = open_run(Path(run.path)).truth
        if truth is None:
            return f"{name}: its log has no truth"
        return associate(merged.trajectory(run), truth, names=(name, "its truth"))
    except MapperError as error:
        return f"{name}: no truth: {error}"


def _rmse_m(matched: Matched, alignment: AlignmentKind) -> float:
    return ate(align(matched, alignment).moved(matched)).rmse
