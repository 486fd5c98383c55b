"""A levelled path placed on Earth by a log's GNSS fixes, and corrected by them where it has drifted."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geodesy import GeodeticOrigin
from mapper.core.geometry import Array, Transform, inverse, transform
from mapper.core.timebase import NS_PER_S, nearest
from mapper.core.trajectory import Trajectory
from mapper.graph.config import GraphConfig
from mapper.graph.gnss_factors import TooShortError, align, check, correct, point_at
from mapper.graph.model import PositionFactor
from mapper.pipeline.tracking_result import TrackingResult
from mapper.run.georeference_record import Georeference
from mapper.run.manifest import RunWarning, Weight
from mapper.sensing.gnss import GnssFixes
from mapper.sensing.wheel_kinematics import pose_at

_MAX_GAP_NS = NS_PER_S
_MIN_FIXES = 6
"""Heading and position take two, and their residuals are to say something."""
_UNKNOWN_SIGMAS_M = np.array([3.3, 3.3, 6.6])
"""Of a fix that states none: 8 m horizontally, 13 m vertically at 95 % (GPS performance standard, 2020)."""
_LEAST_SIGMA_M = 0.02
"""RTK receivers are specified to about 1 cm and 1 ppm."""
_CLOCK_S = 0.05
"""Stamps of fixes tell when they were received; the sensor moves in between."""
_CORRELATION_S = 1.0
"""Time for which receivers smooth: fixes within it count as one. Errors that last longer bend a path that has
drifted less than the drift does, and no other path is bent."""
_ANTENNA_SIGMA_M = 1.0
"""An antenna of unknown place is on the same vehicle."""


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """Result of placing a path on Earth.

    Attributes:
        tracking: The path, in east, north and up of the origin if it was placed.
        T_map_world: (4, 4) how the path was placed, before it was corrected.
        report: Record for the manifest; None if it was not placed.
        warnings: How the fixes were used, or why not.
    """

    tracking: TrackingResult
    T_map_world: Transform = field(default_factory=lambda: np.eye(4))
    report: Georeference | None = None
    warnings: Sequence[RunWarning] = ()


def georeference(tracking: TrackingResult, fixes: GnssFixes | None, config: GraphConfig) -> Georeferenced:
    """Return a levelled path in a local frame of x east, y north and z up, the first pose where it was.

    Where the fixes are farther from the path than their errors explain, the path has drifted, and they become
    factors of its graph; else it keeps its shape, to which they would only add their errors. Fixes that are
    too few, too inaccurate or contradict the path are not used.

    Args:
        tracking: Solved and levelled: z up, the floor at 0.
        fixes: Those of the log; None without.
        config: Settings of GNSS factors and of the solver.
    """
    if fixes is None or not config.gnss.use:
        return Georeferenced(tracking)
    weight: Weight = "doubt"
    trajectory = tracking.tracked_trajectory()
    fixes = fixes.in_degrees(trajectory.stamps_ns, trajectory.positions_world)
    try:
        return _placed(tracking, fixes, config)
    except TooShortError as error:
        reason, weight = str(error), "note"
    except GraphError as error:
        reason = str(error)
    sentence = f"{fixes.name}: not used, the map stays in a frame of its own: {reason}"
    return Georeferenced(tracking, warnings=[RunWarning(kind="gnss", sentence=sentence, weight=weight)])


def _placed(tracking: TrackingResult, fixes: GnssFixes, config: GraphConfig) -> Georeferenced:
    trajectory = tracking.tracked_trajectory()
    first_world = trajectory.positions_world[0]
    origin = GeodeticOrigin(*fixes.geodetic[0].tolist())
    for _ in range(2):  # a tangent frame turns with its origin, which is to be at the first pose
        measured = _along(tracking, trajectory, fixes, origin)
        alignment = align(measured, tracking.graph.T_world_node)
        check(alignment, trajectory.path_length_m)
        offset = point_at(alignment.T_enu_world, first_world) - first_world
        before, origin = origin, origin.moved(offset)
    T_map_enu = transform(np.eye(3), -offset)
    measured = [fix.moved(T_map_enu) for fix in measured]
    graph = tracking.graph.moved(T_map_enu @ alignment.T_enu_world)
    corrected, inliers = correct(graph, measured, config)
    held = [fix for fix, holds in zip(measured, inliers.tolist(), strict=True) if holds]
    rigid = align(held, graph.T_world_node)
    is_corrected = rigid.shows_drift and config.solve == "batch"
    after = replace(tracking, graph=corrected if is_corrected else graph.moved(rigid.T_enu_world))
    shift = first_world - after.tracked_trajectory().positions_world[0]
    T_new_map = transform(np.eye(3), shift)
    after = replace(after, graph=after.graph.moved(T_new_map))
    measured = [fix.moved(T_new_map) for fix in measured]
    origin = before.moved(offset - shift)
    residuals_m = [_distance_m(fix, after) for fix in measured]
    report = Georeference(
        latitude_deg=origin.latitude_deg,
        longitude_deg=origin.longitude_deg,
        height_m=origin.height_m,
        is_corrected=is_corrected,
        fixes=len(measured),
        outliers=int((~inliers).sum()),
        residual_before_m=float(np.median(rigid.residuals_m)),
        residual_m=float(np.median(np.array(residuals_m)[inliers])),
        heading_sigma_rad=alignment.heading_sigma_rad,
        has_antenna=fixes.antenna_body is not None,
    )
    T_map_world = T_new_map @ rigid.T_enu_world @ T_map_enu @ alignment.T_enu_world
    warning = RunWarning(kind="gnss", sentence=f"{fixes.name}: {report.sentence}")
    return Georeferenced(after, T_map_world, report, [warning])


def _distance_m(fix: PositionFactor, tracking: TrackingResult) -> float:
    point_world = point_at(tracking.graph.T_world_node[fix.node], fix.point_node)
    return float(np.linalg.norm(point_world - fix.position_world))


def _along(
    tracking: TrackingResult,
    trajectory: Trajectory,
    fixes: GnssFixes,
    origin: GeodeticOrigin,
) -> list[PositionFactor]:
    """Return for each node the fix nearest in time, with the antenna where it was at the time of the fix.

    Raises:
        TooShortError: There are too few.
    """
    graph = tracking.graph
    nodes = sorted(graph.T_world_node, key=graph.stamps_ns.__getitem__)
    node_ns = np.array([graph.stamps_ns[node] for node in nodes], np.int64)
    index, gap_ns = nearest(fixes.stamps_ns, node_ns)
    antenna_body = np.zeros(3) if fixes.antenna_body is None else fixes.antenna_body
    found = []
    for k in np.unique(index[gap_ns <= _MAX_GAP_NS]).tolist():
        stamp_ns = int(fixes.stamps_ns[k])
        T_world_body = pose_at(trajectory, stamp_ns, max_gap_ns=_MAX_GAP_NS)
        if T_world_body is not None:
            node = nodes[int(nearest(node_ns, fixes.stamps_ns[k : k + 1])[0][0])]
            T_node_body = inverse(graph.T_world_node[node]) @ T_world_body
            found.append((k, node, point_at(T_node_body, antenna_body)))
    if len(found) < _MIN_FIXES:
        raise TooShortError(f"{len(found)} fixes along the path, want at least {_MIN_FIXES}")
    kept = np.array([k for k, _, _ in found], np.intp)
    positions_enu = origin.enu(fixes.geodetic[kept])
    informations = np.linalg.inv(_covariances(fixes.of(kept), trajectory))
    apart_s = np.gradient((fixes.stamps_ns[kept] - fixes.stamps_ns[kept[0]]) / NS_PER_S)
    weights = np.minimum(apart_s / (2.0 * _CORRELATION_S), 1.0)
    return [
        PositionFactor(node, point_node, position, information, weight, int(fixes.stamps_ns[k]))
        for (k, node, point_node), position, information, weight in zip(
            found, positions_enu, informations, weights.tolist(), strict=True
        )
    ]


def _covariances(fixes: GnssFixes, trajectory: Trajectory) -> Array:
    """Return (N, 3, 3) covariances of what fixes say about the path, by the receiver, clock and antenna."""
    stated = fixes.covariances_enu
    covariances = np.where(np.isfinite(stated), stated, np.diag(_UNKNOWN_SIGMAS_M**2))
    since_s = (trajectory.stamps_ns - trajectory.stamps_ns[0]) / NS_PER_S
    speeds_mps = np.linalg.norm(np.gradient(trajectory.positions_world, since_s, axis=0), axis=1)
    speed_mps = np.interp((fixes.stamps_ns - trajectory.stamps_ns[0]) / NS_PER_S, since_s, speeds_mps)
    variances = _LEAST_SIGMA_M**2 + (_CLOCK_S * speed_mps) ** 2
    if fixes.antenna_body is None:
        variances = variances + _ANTENNA_SIGMA_M**2
    return np.asarray(covariances + variances[:, None, None] * np.eye(3))
