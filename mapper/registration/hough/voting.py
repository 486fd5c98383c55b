"""Hough voting over (dx, dy, α) by pairs of centres (Nagy, Gálai & Benedek 2016, §3.3, alg. 1)."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array, Transform, planar_motion
from mapper.registration.hough.config import VotingConfig
from mapper.registration.hough.voting_kernels import vote_slices

_PER_ANGLE = 8
DISTINCT_RAD = 0.09
"""A peak nearer to a higher one than this, and than two bins, is the same peak."""


@dataclass(frozen=True, slots=True)
class Peak:
    """A maximum of the accumulator: o_target = Rot(α)·o_source + (dx, dy).

    Attributes:
        dx_m: Offset along the target's level x.
        dy_m: Offset along its y.
        alpha_rad: Turn about up, counter-clockwise, −π … π.
        votes: Pairs of centres in the peak's bin and the eight around it.
        score: votes / √(n_target · n_source); similar scenes have some tenths, whatever their size.
    """

    dx_m: float
    dy_m: float
    alpha_rad: float
    votes: int
    score: float

    @property
    def motion(self) -> Transform:
        """(4, 4) T_target_source between the two level frames."""
        return planar_motion(self.dx_m, self.dy_m, self.alpha_rad)


def vote(target: Array, source: Array, config: VotingConfig) -> list[Peak]:
    """Return the distinct peaks of the accumulator, the highest first.

    Args:
        target: (N, 2) centres in the target's level frame, metres.
        source: (M, 2) centres in the source's.
        config: Range and resolution of the accumulator.
    """
    if len(target) == 0 or len(source) == 0:
        return []
    alphas = (np.arange(config.angles) - config.angles // 2) * (2.0 * np.pi / config.angles)
    half_bins = int(np.ceil((config.max_offset_m + config.width_m) / config.bin_m))
    votes, offsets = vote_slices(
        np.ascontiguousarray(target),
        np.ascontiguousarray(source),
        np.cos(alphas),
        np.sin(alphas),
        half_bins,
        config.bin_m,
        _PER_ANGLE,
    )
    order = np.argsort(-votes, axis=None, kind="stable")[: np.count_nonzero(votes)]
    offsets_m = config.bin_m * offsets.reshape(-1, 2)[order]
    turns = np.asarray(alphas[order // _PER_ANGLE], dtype=np.float64)
    heights = votes.ravel()[order]
    norm = np.sqrt(len(target) * len(source))
    return [
        Peak(
            dx_m=float(offsets_m[i, 0]),
            dy_m=float(offsets_m[i, 1]),
            alpha_rad=float(turns[i]),
            votes=int(heights[i]),
            score=float(heights[i] / norm),
        )
        for i in distinct(offsets_m, turns, config.peaks, far_m=config.width_m, far_rad=DISTINCT_RAD)
    ]


def distinct(offsets_m: Array, turns_rad: Array, most: int, *, far_m: float, far_rad: float) -> list[int]:
    """Return the indices of the first planar motions that are not near one before them.

    Args:
        offsets_m: (N, 2), the best first.
        turns_rad: (N,).
        most: Largest number kept.
        far_m: Offsets farther apart are distinct.
        far_rad: Turns farther apart are distinct.
    """
    kept: list[int] = []
    left = np.arange(len(turns_rad))
    while len(left) and len(kept) < most:
        best = int(left[0])
        kept.append(best)
        gaps_rad = np.abs(turns_rad[left] - turns_rad[best]) % (2.0 * np.pi)
        gaps_m = np.hypot(*(offsets_m[left] - offsets_m[best]).T)
        left = left[(np.minimum(gaps_rad, 2.0 * np.pi - gaps_rad) > far_rad) | (gaps_m > far_m)]
    return kept
