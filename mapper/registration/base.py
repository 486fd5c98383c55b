"""Interface of registration: two scans and a guess in, a motion and its assessment out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, is_rigid


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The motion found between two observations, and its assessment.

    Attributes:
        T_target_source: (4, 4) pose of the source in the target.
        converged: Whether there is an answer; if not, ``reason`` says why.
        inlier_ratio: Share of the pairs that agree with the motion, 0 … 1.
        inlier_rmse_m: Root mean square distance of those pairs, metres.
        pairs: Number of pairs that agree.
        reason: Why it did not converge; empty when it did.
        information: (6, 6) Fisher information of the source's tangent (rotation, translation), where known.
    """

    T_target_source: Transform
    converged: bool
    inlier_ratio: float
    inlier_rmse_m: float
    pairs: int = 0
    reason: str = ""
    information: Array | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not is_rigid(self.T_target_source):
            raise DataError("alignment: T_target_source is not a finite rigid motion")
        if not self.converged and not self.reason:
            raise DataError("alignment: one that did not converge must say why")


def failed(reason: str) -> Alignment:
    """Return no answer: identity, not converged, with the reason."""
    return Alignment(np.eye(4), converged=False, inlier_ratio=0.0, inlier_rmse_m=float("inf"), reason=reason)


class Aligner(Protocol):
    """A method of registering scans, made with one target, so that its search index is built once."""

    def align(self, source: Scan, T_target_source: Transform) -> Alignment:
        """Return the motion refined from a guess. Pure: the same inputs give the same answer.

        Args:
            source: Its points are aligned to the target's.
            T_target_source: (4, 4) guess. A global method does not use it.
        """
        ...
