"""The floor that a depth camera moves over: its path gets the height and tilt that the floor shows."""

from collections.abc import Container, Iterable
from dataclasses import replace

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.errors import FrameError
from mapper.core.geometry import Array, Transform
from mapper.core.subsampling import stride_for
from mapper.graph.floor_factors import floor_factors, on_one_floor, with_height_and_tilt
from mapper.graph.model import PoseGraph
from mapper.graph.optimize import optimize
from mapper.mapping.floor_planes import floor_plane
from mapper.pipeline.solve import Solved
from mapper.pipeline.tracking_result import BY_POSES
from mapper.run.frame_outcomes import FrameRecord
from mapper.runtime.ordered_map import ordered_map
from mapper.sources.base import FrameRef, Log

_ROUNDS = 3
"""The plane is fitted to the poses and the poses to the plane, in turn."""
_MAX_KEYFRAMES = 400
"""Spread over the log; more hardly change the plane, and take 10 ms each."""

UP_LEVEL = np.array([0.0, 0.0, 1.0])
"""Up in the world of a run."""


def tracked_stamps(records: Iterable[FrameRecord]) -> set[int]:
    """Return the stamps of the frames that were tracked without a doubt."""
    return {record.stamp_ns for record in records if record.outcome == "tracked"}


def above_level_floor(
    source: Log, solved: Solved, config: BuildConfig, *, trusted_ns: Container[int]
) -> Solved:
    """Return a solution in the world of a run as ``above_floor`` does, with the number of nodes reported."""
    graph, nodes = above_floor(source, solved.graph, config, up_world=UP_LEVEL, trusted_ns=trusted_ns)
    return replace(solved, graph=graph, report=solved.report.model_copy(update={"floor_nodes": nodes}))


def above_floor(
    source: Log, graph: PoseGraph, config: BuildConfig, *, up_world: Array, trusted_ns: Container[int]
) -> tuple[PoseGraph, int]:
    """Return a solved graph with the heights and tilts that the floor shows, and how many nodes see it.

    Without one floor that is followed, the graph is returned as it is, and 0.

    Without loops a depth camera's path drifts in height and tilt, along white walls by a decimetre and some
    degrees in ten metres, while every frame that sees the floor shows both to 3 cm and a degree.

    Args:
        source: The log.
        graph: Its graph at the solution.
        config: All settings.
        up_world: (3,) roughly up.
        trusted_ns: Stamps of the frames that are not doubtful.
    """
    if source.sensor != "rgbd" or not config.level.follow_floor:
        return graph, 0
    if config.graph.solve != "batch" or config.odometry.kind in BY_POSES:
        return graph, 0
    T_node_floor = _floors(source, graph, config, up_world, trusted_ns)
    nodes = on_one_floor(graph, T_node_floor)
    if not nodes:
        return graph, 0
    before, held = graph.without_loops().factors, graph
    for _ in range(_ROUNDS):
        factors = floor_factors(held.T_world_node, T_node_floor, nodes)
        held = held.with_factors([*before, *factors, *graph.loops])
        held = held.with_poses(optimize(held, config.graph).T_world_node)
    combined = with_height_and_tilt(graph.T_world_node, held.T_world_node, T_node_floor, nodes)
    return graph.with_poses(combined), len(nodes)


def _floors(
    source: Log, graph: PoseGraph, config: BuildConfig, up_world: Array, trusted_ns: Container[int]
) -> dict[int, Transform]:
    """Return T_node_floor of the nodes that see a floor."""
    nodes = [node for node, stamp_ns in graph.stamps_ns.items() if stamp_ns in trusted_ns]
    nodes = nodes[:: stride_for(len(nodes), _MAX_KEYFRAMES)]
    node_at = {graph.stamps_ns[node]: node for node in nodes}

    def seen(entry: FrameRef) -> tuple[int, Transform | None]:
        node = node_at[entry.stamp_ns]
        try:
            scan = entry.scan()
        except FrameError:
            return node, None  # it was readable in the first pass; fusing reports it
        up_body = graph.T_world_node[node][:3, :3].T @ up_world
        return node, floor_plane(scan, up_body, tolerance_m=config.level.plane_tolerance_m)

    floors = ordered_map(seen, source.entries_of(node_at), workers=config.workers)
    return {node: T_node_floor for node, T_node_floor in floors if T_node_floor is not None}
