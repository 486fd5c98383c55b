"""GNSS in a pose graph: where on Earth its world lies, and factors that correct it where it has drifted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import GraphError
from mapper.core.geometry import Array, Transform, distances_along, transform
from mapper.core.rotations import rotation_from_euler
from mapper.graph.config import GraphConfig
from mapper.graph.gtsam_factors import (
    LEVEL_SIGMA_RAD,
    Kernel,
    between,
    poses_of,
    position,
    upright,
    values_of,
)
from mapper.graph.least_squares import Effort, solve
from mapper.graph.model import PoseGraph, PositionFactor
from mapper.graph.robust import ROUND, Graduated, truncate

_MEDIAN_CHI2, _LIMIT_CHI2 = 2.366, 11.345
"""Median and 99 % of χ² with three degrees of freedom."""
_CAUCHY_WIDTH = 2.385
"""With normal errors Cauchy's kernel of this width has 95 % of the efficiency of least squares."""
_ALIGNMENT_ROUNDS, _EXACT = 10, Effort(max_iterations=20)
_MAX_HEADING_RAD = 0.1
_MAX_RATIO = 1.25
"""Residuals of a path that has not drifted are as large as the fixes' stated errors if these are independent,
and half as large if they change slowly, as most of them then moves the whole path."""
_MAX_TILT_RAD = 0.3
"""A path fits its mirror image only if it is turned over."""
_MAX_DRIFT_SHARE = 0.03
"""Drift, as a share of the path, of an odometry that works; beyond it one of the two is wrong."""
_MIN_INLIERS = 0.5
_BOOSTS, _LEAST_GAIN = (1.0, 10.0), 0.05
_WINDOW_M = 50.0
"""Long enough for a change to stand out from the errors of fixes, and shorter than reflections last."""


class TooShortError(GraphError):
    """A path is too short, or has too few fixes, to be placed by them."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Rigid motion of a path onto its fixes.

    Attributes:
        T_enu_world: (4, 4).
        residuals_m: (N,) distance of each fix from the path.
        chi2: (N,) the same squared, in sigmas of the fix.
        heading_sigma_rad: Standard deviation of the heading.
    """

    T_enu_world: Transform
    residuals_m: Array
    chi2: Array
    heading_sigma_rad: float

    @property
    def shows_drift(self) -> bool:
        """Whether fixes that hold are farther from the rigid path than their own errors explain."""
        return float(np.sqrt(self.chi2.mean() / 3.0)) > _MAX_RATIO


def align(fixes: Sequence[PositionFactor], T_world_node: Mapping[int, Transform]) -> Alignment:
    """Return the motion of a levelled path onto its fixes: heading and position, and tilt within its error.

    A Cauchy kernel, whose width grows with the median residual, gives reflected signals little weight.

    Args:
        fixes: Three or more, in east, north and up.
        T_world_node: (4, 4) poses of the nodes, the world's z being up.

    Raises:
        GraphError: The solver fails.
    """
    points_world = np.array([point_at(T_world_node[fix.node], fix.point_node) for fix in fixes])
    positions_enu = np.array([fix.position_world for fix in fixes])
    spread_m = np.linalg.svd(points_world[:, :2] - points_world[:, :2].mean(axis=0), compute_uv=False)[0]
    whole = [replace(fix, node=0, point_node=point) for fix, point in zip(fixes, points_world, strict=True)]
    T_enu_world, ratio = _planar(positions_enu, points_world), np.inf
    for _ in range(_ALIGNMENT_ROUNDS):
        kernel = Kernel("cauchy", _CAUCHY_WIDTH * ratio) if np.isfinite(ratio) else None
        terms = [position(fix, kernel=kernel) for fix in whole]
        start = {0: T_enu_world}
        level = upright(0, np.eye(4), LEVEL_SIGMA_RAD)
        values, _ = solve(terms, [level], values_of(start, start), effort=_EXACT)
        T_enu_world = poses_of(values)[0]
        residuals = positions_enu - (points_world @ T_enu_world[:3, :3].T + T_enu_world[:3, 3])
        chi2 = _chi2(residuals, whole)
        ratio = max(float(np.sqrt(np.median(chi2) / _MEDIAN_CHI2)), 1.0)
    heading_sigma_rad = _sigma_m(fixes) / max(spread_m / len(fixes) ** 0.5, 1e-9)
    return Alignment(T_enu_world, np.linalg.norm(residuals, axis=1), chi2, float(heading_sigma_rad))


def check(alignment: Alignment, path_m: float) -> None:
    """Refuse fixes that cannot place a path.

    Args:
        alignment: The path on its fixes.
        path_m: Length of the path.

    Raises:
        TooShortError: The heading would be too uncertain.
        GraphError: Fixes and path contradict each other.
    """
    if alignment.heading_sigma_rad > _MAX_HEADING_RAD:
        raise TooShortError(
            f"the path is too short for the fixes' accuracy: its heading would be known to "
            f"{np.degrees(alignment.heading_sigma_rad):.0f}° (1 σ), want at most "
            f"{np.degrees(_MAX_HEADING_RAD):.0f}°"
        )
    tilt_rad = float(np.arccos(np.clip(alignment.T_enu_world[2, 2], -1.0, 1.0)))
    if tilt_rad > _MAX_TILT_RAD:
        raise GraphError(
            f"the fixes contradict the path: they fit it if up is {np.degrees(tilt_rad):.0f}° off, want at "
            f"most {np.degrees(_MAX_TILT_RAD):.0f}°; are they mirrored?"
        )
    median_m = float(np.median(alignment.residuals_m))
    ratio = float(np.sqrt(np.median(alignment.chi2) / _MEDIAN_CHI2))
    limit_m = median_m * min(_MAX_RATIO / max(ratio, 1e-9), 1.0) + _MAX_DRIFT_SHARE * path_m
    if median_m > limit_m:
        raise GraphError(
            f"the fixes contradict the path: they are {median_m:.1f} m from it in the median, on "
            f"{path_m:.0f} m (at most {limit_m:.1f} m by their accuracy and {_MAX_DRIFT_SHARE:.0%} of "
            "drift); is the clock, or the path, wrong?"
        )


def correct(
    graph: PoseGraph, fixes: Sequence[PositionFactor], config: GraphConfig
) -> tuple[PoseGraph, NDArray[np.bool_]]:
    """Return a graph solved with GNSS factors, and (N,) which fixes hold.

    Covariances of relative poses describe noise, and drift is systematic: where more fixes fit if they weigh
    more, they do. A solution that changes a stretch of the path by more than an odometry drifts has followed
    reflected signals, and does not count.

    Args:
        graph: Solved graph, rigidly aligned with the fixes; its factors all hold.
        fixes: In the graph's world, whose z is up.
        config: Termination criteria.

    Raises:
        GraphError: The solver fails, or the fixes contradict the path.
    """
    best: tuple[PoseGraph, NDArray[np.bool_]] | None = None
    share, contradictions = _MIN_INLIERS, []
    for boost in _BOOSTS:
        boosted = [replace(fix, weight=boost * fix.weight) for fix in fixes]
        corrected, inliers = _solved_with(graph, boosted, config)
        change = _largest_change(graph, corrected, _sigma_m(fixes))
        if inliers.mean() < share:
            contradictions.append(f"{inliers.mean():.0%} fit it, want at least {share:.0%}")
        elif change > _MAX_DRIFT_SHARE:
            limit = f"want at most {_MAX_DRIFT_SHARE:.0%}"
            contradictions.append(f"{_WINDOW_M:g} m of it would change by {change:.0%}, {limit}")
        else:
            best, share = (corrected, inliers), float(inliers.mean()) + _LEAST_GAIN
    if best is None:
        raise GraphError(f"the {len(fixes)} fixes contradict the path: {', or '.join(contradictions)}")
    return best


def _solved_with(
    graph: PoseGraph, fixes: Sequence[PositionFactor], config: GraphConfig
) -> tuple[PoseGraph, NDArray[np.bool_]]:
    """Return the graph with the inliers by graduated non-convexity (Yang et al. 2020), and which they are."""
    first = next(iter(graph.T_world_node))
    held = [*map(between, graph.factors), upright(first, graph.T_world_node[first], LEVEL_SIGMA_RAD)]

    def solved(weights: Array, start: Graduated, effort: Effort = ROUND) -> Graduated:
        pairs = zip(fixes, weights.tolist(), strict=True)
        terms = [position(fix, weight=weight) for fix, weight in pairs if weight > 0.0]
        poses, more = solve(held, terms, start.poses, effort=effort)
        T_world_node = poses_of(poses)
        points = np.array([point_at(T_world_node[fix.node], fix.point_node) for fix in fixes])
        residuals = np.array([fix.position_world for fix in fixes]) - points
        return Graduated(poses, _chi2(residuals, fixes), start.iterations + more)

    start = Graduated(values_of(graph.T_world_node, graph.T_world_node), np.empty(0), 0)
    now = solved(np.ones(len(fixes)), start)
    now = truncate(solved, now, worst=float(now.chi2.max()), limit=_LIMIT_CHI2)
    inliers = now.chi2 <= _LIMIT_CHI2
    if inliers.any():
        now = solved(inliers.astype(np.float64), now, Effort(config.max_iterations))
    T_world_node = poses_of(now.poses)
    poses = {node: T_world_node[node] for node in graph.T_world_node}
    held_fixes = tuple(fix for fix, holds in zip(fixes, inliers.tolist(), strict=True) if holds)
    return replace(graph.with_poses(poses), fixes=held_fixes), inliers


def _largest_change(before: PoseGraph, after: PoseGraph, sigma_m: float) -> float:
    """Return the largest share by which a stretch of the path changes, beyond what fixes' errors explain."""
    along_m = distances_along(before.positions)
    ends = np.minimum(np.searchsorted(along_m, along_m + _WINDOW_M), len(along_m) - 1)
    starts = np.flatnonzero(
        (ends > np.arange(len(ends))) & ((ends < len(ends) - 1) | (np.arange(len(ends)) == 0))
    )
    steps = [
        np.einsum(
            "nji,nj->ni", graph.poses[starts, :3, :3], graph.positions[ends[starts]] - graph.positions[starts]
        )
        for graph in (before, after)
    ]
    changes_m = np.linalg.norm(steps[1] - steps[0], axis=1) - sigma_m
    return float((changes_m / np.maximum(along_m[ends[starts]] - along_m[starts], 1.0)).max(initial=0.0))


def _sigma_m(fixes: Sequence[PositionFactor]) -> float:
    """Return the median standard deviation of fixes along east and north."""
    variances = [np.trace(np.linalg.inv(fix.information)[:2, :2]) / 2.0 for fix in fixes]
    return float(np.sqrt(np.median(variances)))


def _chi2(residuals: Array, fixes: Sequence[PositionFactor]) -> Array:
    informations = np.array([fix.information for fix in fixes])
    chi2: Array = np.einsum("ni,nij,nj->n", residuals, informations, residuals)
    return chi2


def _planar(target: Array, source: Array) -> Transform:
    """Return the rotation about z and the translation that bring points onto others, by least squares."""
    to, from_ = target.mean(axis=0), source.mean(axis=0)
    (x, y), (u, v) = (target - to).T[:2], (source - from_).T[:2]
    yaw_rad = np.arctan2((u * y - v * x).sum(), (u * x + v * y).sum())
    R = rotation_from_euler(0.0, 0.0, float(yaw_rad))
    return transform(R, to - R @ from_)


def point_at(T_a_b: Transform, point_b: Array) -> Array:
    """Return (3,) a point of b in a."""
    point: Array = T_a_b[:3, :3] @ point_b + T_a_b[:3, 3]
    return point
