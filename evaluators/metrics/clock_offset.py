"""Clock offset: how much later a truth's stamps are than those of the trajectory that is compared with it."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory_errors import AlignmentKind, Matched, align, ate

_MAX_OFFSET_S = 2.0
_MAX_SHARE = 0.1
"""Of the time that both cover: of a shorter part of a path, almost any lies on almost any other."""
_STEPS_S = (0.05, 0.005, 0.0005)
"""Steps of the search for the least error, each around the best of the one before."""
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
    if widest_s < _STEPS_S[0] or len(compared) < 3:
        return None
    compared = compared[:: -(-len(compared) // _MOST_POSES)]
    stamps_ns, T_map_body = estimate.stamps_ns[compared], estimate.T_world_body[compared]
    at_s, truth_s = ((ns - begin_ns) / NS_PER_S for ns in (stamps_ns, truth.stamps_ns))

    def rmse_m(offset_s: float) -> float:
        T_truth_body = np.tile(np.eye(4), (len(at_s), 1, 1))
        T_truth_body[:, :3, 3] = _interpolated(at_s + offset_s, truth_s, truth.positions)
        matched = Matched(stamps_ns, T_map_body, T_truth_body)
        return round(ate(align(matched, alignment).moved(matched)).rmse, 9)  # less is rounding

    def least(around_s: float, step_s: float, most: int) -> float:
        offsets_s = around_s + step_s * np.arange(-most, most + 1)
        return float(offsets_s[np.argmin([rmse_m(offset_s) for offset_s in offsets_s])])

    coarsest_s = _STEPS_S[0]
    most = int(widest_s / coarsest_s)
    found_s = least(0.0, coarsest_s, most)
    if abs(found_s) == most * coarsest_s:  # the least error may lie beyond
        return None
    for step_s in _STEPS_S[1:]:
        found_s = least(found_s, step_s, 10)
    if rmse_m(found_s) >= _MAX_RATIO * rmse_m(0.0):
        return None
    return ClockOffset(found_s, rmse_m(found_s))


def _interpolated(at_s: Array, known_s: Array, positions: Array) -> Array:
    return np.column_stack([np.interp(at_s, known_s, coordinate) for coordinate in positions.T])
