"""MCAP log of a run: transforms, diagnostics, trajectories, factors, snapshots and maps."""

import math
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from mapper.core.doubts import doubts_text
from mapper.export.figures import TRUTH
from mapper.export.mcap_log import McapLog
from mapper.export.transforms import Transforms
from mapper.loops.closure import Discrepancy, LoopClosure
from mapper.mapping.cloud import height_colors, thinned_to_view
from mapper.mapping.map_building import Maps, ScanSnapshot, Snapshot
from mapper.run.frame_records import FrameRecord
from mapper.run.results import RunResults


def log_results(log: McapLog, results: RunResults, transforms: Transforms) -> None:
    """Log the transforms, diagnostics, trajectories and factors.

    What belongs to the whole log is logged at its first stamp, as :class:`McapLog` advises.
    """
    begin_ns = int(results.trajectory.stamps_ns[0])
    log.trajectory(begin_ns, results.trajectory, name="estimate")
    if results.truth is not None:
        log.trajectory(begin_ns, results.truth, name="truth", color=TRUTH)
    log.factors(begin_ns, results.graph.factors, T_world_node=results.graph.T_world_node)
    log.static_transforms(begin_ns, transforms.static)
    for stamp_ns, links in transforms.moving:
        for parent, child, T_parent_child in links:
            log.transform(stamp_ns, T_parent_child, parent=parent, child=child)
    poses = results.poses
    for (stamp_ns, T_world_body), covariance in zip(poses.trajectory.items(), poses.covariances, strict=True):
        if np.isfinite(covariance).all():
            log.pose(stamp_ns, T_world_body, covariance)
    for record in results.records:
        log.diagnostics(record.stamp_ns, _fields(record, results.frame_ms))
    for loop in results.loops:
        log.loop(loop.stamp_j_ns, _loop_fields(loop))


def log_snapshot(log: McapLog, transforms: Transforms, snapshot: Snapshot | ScanSnapshot) -> None:
    """Log an image with its camera and where that sits on the body, or a scan by height."""
    body = transforms.body
    if isinstance(snapshot, ScanSnapshot):
        points_body = snapshot.points_body
        log.scan(snapshot.stamp_ns, points_body, colors=height_colors(points_body[:, 2]), frame=body)
        return
    camera = transforms.camera_of(snapshot)
    if camera != body:
        log.transform(snapshot.stamp_ns, snapshot.T_body_camera, parent=body, child=camera)
    log.calibration(snapshot.stamp_ns, snapshot.camera, frame=camera)
    log.image(snapshot.stamp_ns, snapshot.jpeg, frame=camera)


def log_maps(log: McapLog, maps: Maps, *, stamp_ns: int) -> None:
    """Log the occupied voxels by height, the coloured clouds, the slice and the traversable floor."""
    occupied_world = maps.octree.occupied()
    for name, points_world, colors in (
        ("octree", occupied_world, height_colors(occupied_world[:, 2])),
        ("cloud", maps.cloud.points, maps.cloud.colors),
        ("dynamic", maps.dynamic.points, maps.dynamic.colors),
    ):
        shown_world, colors_shown = thinned_to_view(points_world, colors)
        log.cloud(stamp_ns, shown_world, colors=colors_shown, name=name)
    log.grid(stamp_ns, maps.grid)
    log.grid(stamp_ns, maps.traversable, name="traversable")
    for number, storey in enumerate(maps.storeys):
        log.grid(stamp_ns, storey, name=f"traversable_{number}")


def _loop_fields(loop: LoopClosure) -> dict[str, int | float | str]:
    """Return numbers and words of a fixed kind: what is not known is NaN."""
    before = loop.before or Discrepancy(math.nan, math.nan)
    after = loop.after or Discrepancy(math.nan, math.nan)
    return {
        "i": loop.i,
        "j": loop.j,
        "verdict": loop.verdict,
        "reason": loop.reason,
        "proposed_by": loop.proposed_by,
        "similarity": _number(loop.similarity),
        "matches": loop.matches,
        "inliers": loop.inliers,
        "rmse_m": _number(loop.rmse_m),
        "residual_px": _number(loop.residual_px),
        "weight": _number(loop.weight),
        "before_m": before.translation_m,
        "before_rad": before.rotation_rad,
        "after_m": after.translation_m,
        "after_rad": after.rotation_rad,
    }


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _fields(record: FrameRecord, frame_ms: Mapping[int, float]) -> dict[str, int | float | str]:
    fields = {
        "outcome": record.outcome,
        "node": -1 if record.node is None else record.node,
        "is_keyframe": int(record.is_keyframe),
        **asdict(record.diagnostics),
        "doubts": doubts_text(record.doubts),
    }
    if frame_ms:
        fields["ms"] = frame_ms.get(record.stamp_ns, 0.0)
    return fields
