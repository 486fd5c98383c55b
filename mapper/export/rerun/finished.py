"""A finished run, or a registration, as a Rerun recording."""

from collections.abc import Iterable, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mapper.core.frames import Points32, Sensor
from mapper.core.geometry import Array, Transform
from mapper.export.figures import ESTIMATE, TRUTH
from mapper.export.rerun.recording import LINE_PX, RerunLog, new_recording, recorded, transform_of
from mapper.export.rerun.target import streaming
from mapper.export.run_maps import maps_of, snapshots_of
from mapper.mapping.cloud import thinned_to_view
from mapper.mapping.map_building import Maps
from mapper.run.folder import Run
from mapper.run.results import RunResults


def show_run(run: Run, target: str) -> None:
    """Send a finished run to a target: FILE.rrd, "spawn", "connect" or "connect:URL".

    Raises:
        ConfigError: The target is none.
        ViewerError: No viewer can be started or reached.
        MapperError: A file of the run cannot be read.
    """
    results, maps, snapshots = run.results, maps_of(run), list(snapshots_of(run))
    name, corners = run.path.name, extent(results, maps)
    with recorded(target, name=name, has_images=bool(snapshots), looking_at=corners) as log:
        log.images(snapshots)
        log.poses(results.trajectory)
        log_run(log, results, maps)
        log.diagnostics(results.records)
        log.about(about_text(run, name=run.path.name))


def log_run(log: RerunLog, results: RunResults, maps: Maps) -> None:
    """Log the results of a run, its maps included."""
    paths = {"estimate": results.trajectory}
    if results.truth is not None:
        paths["truth"] = results.truth
    for name, trajectory in paths.items():
        log.path(name, trajectory)
    log.graph(results.graph)
    log.loops(results.loops, results.graph.T_world_node)
    log.times(results.frame_ms)
    log.voxels(maps.octree)
    log.cloud(*thinned_to_view(maps.cloud.points, maps.cloud.colors))
    log.grid("slice", maps.grid)
    log.grid("traversable", maps.traversable)
    for number, storey in enumerate(maps.storeys):
        log.grid(f"traversable_{number}", storey)
    log.plan(maps.grid, paths)


def extent(results: RunResults, maps: Maps) -> Array:
    """Return the (2, 3) lower and upper corner around the path and all but a few stray points, metres."""
    seen = [results.trajectory.positions_world]
    if len(maps.cloud.points):
        seen.append(np.percentile(maps.cloud.points, [2.0, 98.0], axis=0))
    points_world = np.concatenate(seen)
    return np.array([points_world.min(axis=0), points_world.max(axis=0)])


def about_text(run: Run, *, name: str) -> str:
    """Return a run as Markdown: its log, counts, odometry and times."""
    manifest = run.manifest
    counts, timing, verdict = manifest.counts, manifest.timing, run.verdict
    rows: Iterable[tuple[str, str]] = (
        ("log", f"{manifest.input.title} ({manifest.input.kind})"),
        ("verdict", " ".join([verdict.state, *verdict.sentences])),
        ("frames", counts.frames_text),
        ("graph", f"{counts.nodes} nodes, {counts.factors} factors"),
        ("loops", f"{counts.loops} of {counts.loop_candidates} candidates hold"),
        ("octree", f"{counts.voxels_text} of {run.config.octree.resolution_m:g} m"),
        ("odometry", run.config.odometry.kind),
        ("seconds", f"{timing.total_s:.1f}, {timing.real_time_factor:.2f} × real time"),
        ("mapper", manifest.mapper_version),
    )
    table = "\n".join(f"| {name} | {text.replace('|', '∣')} |" for name, text in rows)
    return f"# {name}\n\n| | |\n| --- | --- |\n{table}\n"


_TIMELINE = "stage"
_UP = {"rgbd": rr.ViewCoordinates.RDF} | dict.fromkeys(
    ("lidar", "lidar-2d"), rr.ViewCoordinates.RIGHT_HAND_Z_UP
)


def record_registration(
    target: str,
    points_target: Points32,
    points_source: Points32,
    stages: Sequence[tuple[str, Transform]],
    *,
    sensor: Sensor,
    name: str,
) -> None:
    """Send both clouds to a file or a viewer; the timeline "stage" steps from the beginning to the answer.

    Args:
        target: FILE.rrd, "spawn", "connect" or "connect:URL", as ``streaming`` takes it.
        points_target: (N, 3) metres; the recording's world is the target's frame.
        points_source: (M, 3) metres, source frame.
        stages: A line of text on each, and T_target_source after it.
        sensor: Determines which axis is up.
        name: Name of the recording in the viewer.

    Raises:
        ConfigError: The target is none.
        ViewerError: No viewer can be started or reached.
    """
    recording = new_recording()
    with streaming(recording, target, _blueprint(), keeps=lambda: False):
        recording.send_recording_name(name)
        recording.log("world", _UP[sensor], static=True)
        for entity, points, color in (
            ("world/target", points_target, TRUTH),
            ("world/source", points_source, ESTIMATE),
        ):
            cloud = rr.Points3D(points.astype(np.float32), colors=[color], radii=LINE_PX)
            recording.log(entity, cloud, static=True)
        for number, (text, T_target_source) in enumerate(stages):
            recording.set_time(_TIMELINE, sequence=number)
            recording.log("world/source", transform_of(T_target_source))
            recording.log("stages", rr.TextLog(text))


def _blueprint() -> rrb.Blueprint:
    views = rrb.Vertical(
        rrb.Spatial3DView(name="clouds", origin="/world"),
        rrb.TextLogView(name="stages", origin="/stages"),
        row_shares=[5, 1],
    )
    return rrb.Blueprint(views, rrb.TimePanel(timeline=_TIMELINE), auto_views=False, collapse_panels=True)
