"""Warnings about a run's pose graph: its loops, its wheel factors, its uncertainty."""

from collections.abc import Iterator, Sequence

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geometry import distances_along, inverse, log
from mapper.graph.marginals import marginals_of
from mapper.graph.model import PoseGraph
from mapper.loops.closure import MIN_CONFLICTS, SOLVER
from mapper.run.manifest import RunWarning
from mapper.run.results import RunResults
from mapper.run.timeline import TimeLine, counted

MAX_DRIFT_SHARE, HARMLESS_M = 0.03, 0.1
"""Error of a path as a share of its length, and one that is small on any path."""
_MAX_LOOP_M, _MAX_LOOP_RAD = 0.3, np.radians(10.0)
_MAX_REFUSED_SHARE = 0.5
_MAX_WHEEL_CHI2, _LEAST_WHEEL_FACTORS = 9.0, 5
_MAX_SIGMA_SHARE, _BROKEN_SIGMA_SHARE = 0.1, 0.3
MAX_STEP_M, MAX_STEP_RAD = 0.2, np.radians(5.0)

_LOOK_AT_LOOPS = "mapper loops RUN lists them; mapper loops RUN --remove I J takes a wrong one back"


def ways_to_hold(results: RunResults) -> str:
    """Return what to try where a path is uncertain: loops where there are some, else what does without."""
    if any(loop.verdict == "accepted" for loop in results.loops):
        return "come back to known places, so that loops hold the path"
    wheels = "" if results.graph.has_wheels else "wheel odometry (wheels.txt), or "
    return f"{wheels}the poses of another odometry (odometry.kind=given)"


def loop_warnings(results: RunResults) -> Iterator[RunWarning]:
    """Yield what is suspicious about loops: far from the odometry, or against the rest of the graph."""
    held = [loop for loop in results.loops if loop.verdict == "accepted" and loop.before is not None]
    contradicting = [loop for loop in results.loops if loop.rejected_by == SOLVER]
    tried = len(held) + len(contradicting)
    if len(contradicting) >= MIN_CONFLICTS and len(contradicting) > _MAX_REFUSED_SHARE * tried:
        yield RunWarning(
            kind="loops",
            sentence=f"{len(contradicting)} of {tried} loops contradict the rest of the graph "
            f"(at most {_MAX_REFUSED_SHARE:.0%} is usual)",
            suggestion=_LOOK_AT_LOOPS,
            weight="doubt",
        )
    if not held:
        return
    before = [loop.before for loop in held if loop.before is not None]
    miss_m = float(np.median([miss.translation_m for miss in before]))
    miss_rad = float(np.median([miss.rotation_rad for miss in before]))
    stamps_ns = results.trajectory.stamps_ns
    travelled_m = distances_along(results.trajectory.positions_world)
    ends = np.searchsorted(stamps_ns, [[loop.stamp_i_ns, loop.stamp_j_ns] for loop in held])
    ends = np.minimum(ends, len(stamps_ns) - 1)
    path_m = float(np.median(np.abs(np.diff(travelled_m[ends], axis=1))))
    limit_m = max(_MAX_LOOP_M, MAX_DRIFT_SHARE * path_m)
    if miss_m <= limit_m and miss_rad <= _MAX_LOOP_RAD:
        return
    yield RunWarning(
        kind="loops",
        sentence=f"before the solve the median loop was {miss_m:.2f} m and {np.degrees(miss_rad):.1f}° "
        f"from the odometry, over {path_m:.1f} m of path (at most {limit_m:.2f} m and "
        f"{np.degrees(_MAX_LOOP_RAD):.0f}° are usual): either the odometry is wrong or the loops are",
        suggestion=_LOOK_AT_LOOPS,
        weight="doubt",
    )


def wheel_warnings(results: RunResults) -> Iterator[RunWarning]:
    """Yield a warning if wheel factors are farther from the solution than their noise explains."""
    T_world_node = results.graph.T_world_node
    factors = [factor for factor in results.graph.factors if factor.origin == "wheel"]
    if len(factors) < _LEAST_WHEEL_FACTORS:
        return
    misses = [
        np.concatenate(log(inverse(factor.T_i_j) @ inverse(T_world_node[factor.i]) @ T_world_node[factor.j]))
        for factor in factors
    ]
    chi2 = [
        float(miss @ factor.information @ miss) / 6.0 for miss, factor in zip(misses, factors, strict=True)
    ]
    if np.median(chi2) <= _MAX_WHEEL_CHI2:
        return
    miss_m = float(np.median([np.linalg.norm(miss[3:]) for miss in misses]))
    moved_m = float(np.median([np.linalg.norm(factor.T_i_j[:3, 3]) for factor in factors]))
    yield RunWarning(
        kind="wheels",
        sentence=f"wheels and odometry disagree: in the median by {miss_m:.2f} m where keyframes are "
        f"{moved_m:.2f} m apart, {np.sqrt(np.median(chi2)):.0f} times what their noise explains "
        f"(at most {np.sqrt(_MAX_WHEEL_CHI2):.0f} is usual)",
        suggestion="check the wheels' calibration and clock, and the mounting of the sensor",
        weight="doubt",
    )


def uncertainty_warnings(results: RunResults, suggestion: str) -> Iterator[RunWarning]:
    """Yield a warning, with what to try, if the end of the path is uncertain."""
    path_m = results.trajectory.path_length_m
    sigma_m = results.poses.end_sigma_m  # no limit is exceeded by NaN
    share = sigma_m / max(path_m, 1e-9)
    if sigma_m > HARMLESS_M and share > _MAX_SIGMA_SHARE:
        yield RunWarning(
            kind="uncertainty",
            sentence=f"the last pose is known to {sigma_m:.2g} m (1 σ) after {path_m:.1f} m of path "
            f"({share:.0%}, at most {_MAX_SIGMA_SHARE:.0%} is usual)",
            suggestion=suggestion,
            weight="break" if share > _BROKEN_SIGMA_SHARE else "doubt",
        )


def step_warnings(results: RunResults, timeline: TimeLine, suggestion: str) -> Iterator[RunWarning]:
    """Yield a warning, with what to try, if uncertain steps connect two parts of the path.

    The first or last few frames are no such part.
    """
    try:
        relative = marginals_of(results.graph).relative
    except GraphError:
        return
    sigmas = {
        nodes: np.sqrt([covariance[part, part].trace() for part in (slice(3, 6), slice(0, 3))])
        for nodes, covariance in relative.items()
    }
    wide = {
        nodes: timeline.span(*(results.graph.stamps_ns[node] for node in nodes))
        for nodes, (m, rad) in sigmas.items()
        if m > MAX_STEP_M or rad > MAX_STEP_RAD
    }
    wide = {nodes: span for nodes, span in wide.items() if not timeline.is_at_an_end(*span)}
    if not wide:
        return
    worst = max(wide, key=lambda nodes: float(sigmas[nodes][0]))
    worst_m, worst_rad = sigmas[worst]
    steps = counted(_stretches([*wide], results.graph), "step")
    yield RunWarning(
        kind="uncertainty",
        sentence=f"{steps} between keyframes known to {MAX_STEP_M:g} m or "
        f"{np.degrees(MAX_STEP_RAD):.0f}° at best (1 σ), the worst to {worst_m:.2g} m and "
        f"{np.degrees(worst_rad):.2g}°: the parts before and after may not fit",
        where=timeline.place(*wide[worst]),
        suggestion=suggestion,
        weight="doubt",
    )


def _stretches(pairs: Sequence[tuple[int, int]], graph: PoseGraph) -> int:
    """Return how many stretches of time some pairs of nodes span: pairs that overlap in time are one."""
    spans = sorted(sorted(graph.stamps_ns[node] for node in pair) for pair in pairs)
    count, until_ns = 0, -1
    for begin_ns, end_ns in spans:
        count += begin_ns >= until_ns
        until_ns = max(until_ns, end_ns)
    return count
