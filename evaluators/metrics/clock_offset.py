"""Clock offset: how much later a truth's stamps are than those of the trajectory that is compared with it."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory import AlignmentKind, Matched, align, ate

_MAX_OFFSET_S = 2.0
_MAX_SHARE = 0.1
"""Of the time that both cover: of a shorter part of a path, almost any lies on almost any other."""
_STEP_S = 0.05
_MOST_POSES = 2000
_MAX_RATIO = 1.0 / 3.0
"""Of the errors with and without an offset, above which the offset may be chance or the errors' own shape."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Clock offset that explains most of a position error.

    Attributes:
        offset_s: Delay of the truth's stamps, seconds.
        rmse_m: RMSE of the positions without it, metres, after the alignment.
    """

    offset_s: float
    rmse_m: float


def clock_offset(estimate: Trajectory, truth: Trajectory, alignment: AlignmentKind) -> ClockOffset | None:
    """Return the clock offset that explains at least two thirds of the position error, or None (within 2 s).

    The true positions are interpolated at the estimate's stamps plus each offset, and aligned.
    """
    begin_ns = max(int(estimate.stamps_ns[0]), int(truth.stamps_ns[0]))
    end_ns = min(int(estimate.stamps_ns[-1]), int(truth.stamps_ns[-1]))
    widest_s = min(_MAX_OFFSET_S, _MAX_SHARE * (end_ns - begin_ns) / NS_PER_S)
    margin_ns = round(widest_s * NS_PER_S)
    compared = np.flatnonzero(
        (estimate.stamps_ns >= truth.stamps_ns[0] + margin_ns)
        & (estimate.stamps_ns <= truth.stamps_ns[-1] - margin_ns)
    )
    if widest_s < _STEP_S or len(compared) < 3:
        return None
    compared = compared[:: -(-len(compared) // _MOST_POSES)]
    stamps_ns, T_map_body = estimate.stamps_ns[compared], estimate.T_world_body[compared]
    at_s, truth_s = ((ns - begin_ns) / NS_PER_S for ns in (stamps_ns, truth.stamps_ns))

    def rmse_m(offset_s: float) -> float:
        T_truth_body = np.tile(np.eye(4), (len(at_s), 1, 1))
        T_truth_body[:, :3, 3] = _interpolated(at_s + offset_s, truth_s, truth.positions)
        matched = Matched(stamps_ns, T_map_body, T_truth_body)
        return ate(align(matched, alignment).moved(matched)).rmse

    steps = np.arange(1, int(widest_s / _STEP_S) + 1) * _STEP_S
    grid_s = np.concatenate([-steps[::-1], [0.0], steps])
    nearest_s = float(grid_s[np.argmin([rmse_m(offset_s) for offset_s in grid_s])])
    if abs(nearest_s) == steps[-1]:  # the least error may lie beyond
        return None
    bounds = (nearest_s - _STEP_S, nearest_s + _STEP_S)
    found = minimize_scalar(rmse_m, bounds=bounds, method="bounded", options={"xatol": 1e-4})
    if found.fun > _MAX_RATIO * rmse_m(0.0):
        return None
    return ClockOffset(float(found.x), float(found.fun))


def _interpolated(at_s: Array, known_s: Array, positions: Array) -> Array:
    return np.column_stack([np.interp(at_s, known_s, coordinate) for coordinate in positions.T])
