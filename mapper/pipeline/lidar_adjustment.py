"""Plane adjustment of a solved log, kept where surfaces of points that took no part are thinner, too."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.errors import FrameError
from mapper.core.geometry import Array, apply, inverse, stride_for
from mapper.core.trajectory import Trajectory
from mapper.features.frame_view import ScanView
from mapper.graph.lidar_bundle_adjustment import NodeClouds, adjust_planes, compare_thickness
from mapper.graph.model import PoseGraph
from mapper.odometry.gyroscope_calibration import with_body_rates
from mapper.odometry.scans.adapted_lengths import adapted_to
from mapper.odometry.scans.config import AnyScanOdometryConfig
from mapper.pipeline.reobserve import reobserve_each
from mapper.pipeline.tracking_result import TrackingResult
from mapper.run.doubtful_frames import without_doubtful
from mapper.run.manifest import SURE_SIGMAS, PlaneAdjustment, Solve
from mapper.run.stored_tracking import StoredTracking
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log

_MOST_POINTS = 10_000_000
"""Of all scans, which 1.5 GB hold; scans of longer logs are thinned further."""
_FEWEST_NODES = 30
"""Standard errors of clusters need some thirty of them (Cameron & Miller 2015, §VI), and a node shows one
place or less: of shorter logs the judge would know little."""


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedPlanes:
    """Result of a plane adjustment.

    Attributes:
        graph: At the adjusted poses if they are kept, else as it was.
        report: Record for the manifest; None if nothing was adjusted.
    """

    graph: PoseGraph
    report: PlaneAdjustment | None = None


def adjust_to_planes(
    source: Log,
    graph: PoseGraph,
    trajectory: Trajectory,
    node_of: Mapping[int, int],
    config: BuildConfig,
    *,
    progress: Progress = SILENT,
) -> AdjustedPlanes:
    """Return a solved graph at poses at which the surfaces of its scans are thinner, if there are such.

    Half of the points adjust the poses, the others judge: the adjustment is kept if their surfaces, too,
    become thinner by more than two standard errors. Only poses of 30 nodes or more are adjusted, of 3D scans
    that an odometry of scans has found and a batch solve has solved.

    Args:
        source: The log, with the body's rates if it has a gyroscope.
        graph: Solved.
        trajectory: T_world_body of the frames that are placed without a doubt, at the graph's poses.
        node_of: Their nodes, by stamp.
        config: All settings.
        progress: Receives stages, counts and the outcome as a note.
    """
    if (
        config.graph.planes == "off"
        or config.graph.solve != "batch"
        or source.sensor != "lidar"
        or len(graph.T_world_node) < _FEWEST_NODES
        or not isinstance(config.odometry, AnyScanOdometryConfig)
    ):
        return AdjustedPlanes(graph)
    adapted = adapted_to(config.odometry, source)
    assert isinstance(adapted, AnyScanOdometryConfig)
    try:
        clouds = _clouds(source, graph, trajectory, node_of, config, progress)
    except FrameError as error:  # it was readable in the first pass
        progress.note(f"poses are not adjusted to planes: {error}")
        return AdjustedPlanes(graph)
    is_judge = np.arange(len(clouds.nodes)) % 2 == 1
    with progress.stage("adjust") as report:
        adjusted = adjust_planes(graph, clouds[~is_judge], voxel_m=adapted.voxel_m, report=report)
        judged = compare_thickness(clouds[is_judge], graph.poses, adjusted.poses, voxel_m=adapted.voxel_m)
    if judged is None:
        return AdjustedPlanes(graph)
    moved_m = np.linalg.norm(adjusted.positions - graph.positions, axis=1)
    found = PlaneAdjustment(
        is_kept=judged.thinner_sigmas > SURE_SIGMAS,
        surfaces=judged.surfaces,
        thinner_sigmas=judged.thinner_sigmas,
        thickness_before_m=judged.before_m,
        thickness_m=judged.after_m,
        moved_m=float(np.sqrt((moved_m**2).mean())),
    )
    progress.note(found.sentence)
    return AdjustedPlanes(adjusted if found.is_kept else graph, found)


def adjust_tracking(
    source: Log, tracking: TrackingResult, config: BuildConfig, *, progress: Progress = SILENT
) -> tuple[TrackingResult, PlaneAdjustment | None]:
    """Return a tracked log that was just solved, adjusted as ``adjust_to_planes`` does, and the record."""
    adjusted = adjust_to_planes(
        with_body_rates(source, tracking.gyroscope),
        tracking.graph,
        tracking.tracked_trajectory(),
        {track.stamp_ns: track.node for track in tracking.tracked if track.node is not None},
        config,
        progress=progress,
    )
    return replace(tracking, graph=adjusted.graph), adjusted.report


def adjust_stored(
    source: Log,
    tracked: StoredTracking,
    report: Solve,
    config: BuildConfig,
    *,
    progress: Progress = SILENT,
) -> tuple[StoredTracking, Solve]:
    """Return a stored log that was just solved, adjusted as ``adjust_to_planes`` does, and its record."""
    adjusted = adjust_to_planes(
        source,
        tracked.graph,
        without_doubtful(tracked.trajectory, tracked.records),
        {r.stamp_ns: r.node for r in tracked.records if r.outcome == "tracked" and r.node is not None},
        config,
        progress=progress,
    )
    return (
        tracked.solved(adjusted.graph, tracked.loops),
        report.model_copy(update={"planes": adjusted.report}),
    )


def _clouds(
    source: Log,
    graph: PoseGraph,
    trajectory: Trajectory,
    node_of: Mapping[int, int],
    config: BuildConfig,
    progress: Progress,
) -> NodeClouds:
    """Return the points of all scans in their nodes.

    Raises:
        FrameError: A scan cannot be read.
    """
    row_of = {node: row for row, node in enumerate(graph.T_world_node)}
    T_world_body = dict(trajectory.items())
    most = _MOST_POINTS // max(len(node_of), 1)
    points: list[Array] = [np.empty((0, 3))]
    counts, rows = [], []
    for stamp_ns, view in reobserve_each(source, trajectory, node_of.keys(), config, progress=progress):
        assert isinstance(view, ScanView)
        few = view.points_body[:: stride_for(len(view.points_body), most)].astype(np.float64)
        node = node_of[stamp_ns]
        points.append(apply(inverse(graph.T_world_node[node]) @ T_world_body[stamp_ns], few))
        counts.append(len(few))
        rows.append(row_of[node])
    return NodeClouds(np.concatenate(points), np.repeat(np.array(rows, np.int64), counts))
