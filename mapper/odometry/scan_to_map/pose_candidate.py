"""Poses found for one scan, and which of them is the best."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.geometry import Transform, angle_between, inverse
from mapper.odometry.scan_to_map.observed_part import Blend
from mapper.odometry.scan_to_map.scan_fit import ScanFit, ScanKeyframe
from mapper.odometry.scan_to_map.usual_fit import Jump, Shares

ALIKE = 0.1
"""Scores nearer than this do not decide."""
_SAME_VOXELS, _SAME_RAD = 0.25, 0.01  # two poses found by a registration that differ less are one
_OTHER_RAD = 0.1  # poses this far apart, or by the largest pair distance, are not the same


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """A pose of the body in the middle of a scan's sweep.

    Attributes:
        keyframe: That it was compared with.
        T_world_middle: (4, 4) the pose.
        fit: On that keyframe.
        shares: What of it is compared with the usual.
        jump: From the predicted pose.
        blend: Of what was found and what was predicted.
        method: Step that found it.
        second_score: Highest score of another pose; -inf if no other was found.
    """

    keyframe: ScanKeyframe
    T_world_middle: Transform
    fit: ScanFit
    shares: Shares
    jump: Jump
    blend: Blend
    method: str
    second_score: float = -np.inf

    @property
    def was_searched(self) -> bool:
        """Whether it was found from other guesses than the predicted pose."""
        return self.method not in {"map", "far"}

    @property
    def is_one_of_two(self) -> bool:
        """Whether another pose fits as well."""
        return self.was_searched and self.score < self.second_score + ALIKE

    @property
    def is_measured(self) -> bool:
        """Whether surfaces show all of the motion."""
        return bool(self.fit.observability.min() >= 1.0)

    @property
    def score(self) -> float:
        """Of the shares: agreement less what contradicts."""
        return self.shares.score


class FoundPoses:
    """Poses that registrations found, each with the guesses that led to it."""

    def __init__(self, voxel_m: float, first: Sequence[Transform]) -> None:
        """Begin with poses that guess 0 led to."""
        self._near_m = _SAME_VOXELS * voxel_m
        self._poses = [(T_world_body, {0}) for T_world_body in first]

    def add(self, T_world_body: Transform, guess: int) -> bool:
        """Add a pose; return whether it is a new one."""
        if (guesses := self._of(T_world_body)) is not None:
            guesses.add(guess)
            return False
        self._poses.append((T_world_body, {guess}))
        return True

    def guesses_of(self, T_world_body: Transform) -> int:
        """Return how many guesses led to a pose."""
        return len(self._of(T_world_body) or ())

    def _of(self, T_world_body: Transform) -> set[int] | None:
        for other, guesses in self._poses:
            if _are_near(other, T_world_body, self._near_m, _SAME_RAD):
                return guesses
        return None


def best_of(candidates: Sequence[PoseCandidate], *, other_m: float) -> PoseCandidate | None:
    """Return the best score, of those alike the one nearest to the predicted pose; None without any.

    Args:
        candidates: Of one scan.
        other_m: Poses this far apart are not the same; the best gets the score of the next best such pose.
    """
    if not candidates:
        return None
    highest = max(candidate.score for candidate in candidates)
    alike = [candidate for candidate in candidates if candidate.score >= highest - ALIKE]
    jumps = [_relative_jump(candidate) for candidate in alike]
    least = min(jumps)
    best = max(
        (c for c, jump in zip(alike, jumps, strict=True) if jump <= least + 1.0),
        key=lambda candidate: candidate.score,
    )
    others = (
        candidate.score
        for candidate in candidates
        if not _are_near(candidate.T_world_middle, best.T_world_middle, other_m, _OTHER_RAD)
    )
    return replace(best, second_score=max(others, default=-np.inf))


def _are_near(T_world_one: Transform, T_world_other: Transform, near_m: float, near_rad: float) -> bool:
    difference = inverse(T_world_one) @ T_world_other
    return bool(
        np.linalg.norm(difference[:3, 3]) < near_m and angle_between(np.eye(3), difference[:3, :3]) < near_rad
    )


def _relative_jump(candidate: PoseCandidate) -> float:
    """Return the jump in units of its limit, or of 1 m and 1 rad where that is unknown."""
    jump = candidate.jump
    if not np.isfinite(jump.limit_m):
        return jump.translation_m + jump.rotation_rad
    return max(jump.translation_m / jump.limit_m, jump.rotation_rad / jump.limit_rad)
