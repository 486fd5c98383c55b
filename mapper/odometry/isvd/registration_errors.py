"""Errors of a log's registrations, which give the uncertainty of its poses."""

import math
from bisect import insort
from collections.abc import Sequence

import numpy as np

from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.odometry.isvd.frames import PoseCandidate
from mapper.odometry.local_map.bundle.log_residuals import LogResiduals

_MEMORY_S = 1.0
"""Time constant of the sums. Synthetic and real logs' NEES change by a tenth between 0.5 and 2 s."""
_USUAL, _COUNTED = 3.0, 30
"""Repetition of a log's errors before it is measured, and as how many registrations that counts."""


class RegistrationErrors:
    """Statistics of the residuals of all registrations: their size, and how far frames repeat them.

    Registrations against one keyframe share the errors of its points, and those that lens and depth make at
    the same places of all images. These do not average out over the frames, which the graph takes for
    independent. By how much they raise the variance of a mean over frames is estimated as for any serially
    correlated scores (Newey & West 1987): from the products of what a cell of the image scores in one frame,
    and in those before it against the same keyframe.
    """

    def __init__(self) -> None:
        self._residuals = LogResiduals()
        self._scales: list[float] = []  # of the frames, in increasing order
        self._sums: dict[int, Array] = {}  # of the cells' scores, by the node registered against
        self._stamp_ns = 0
        self._own, self._repeated = float(_COUNTED), 0.5 * (_USUAL - 1.0) * _COUNTED

    @property
    def repetition(self) -> float:
        """Factor by which errors that frames repeat raise the variance of a mean over them; 1 without any."""
        return max(1.0, 1.0 + 2.0 * self._repeated / self._own)

    def add(self, stamp_ns: int, candidates: Sequence[PoseCandidate]) -> None:
        """Add the registrations of the next frame."""
        kept = math.exp((self._stamp_ns - stamp_ns) / (_MEMORY_S * NS_PER_S))
        self._stamp_ns, before, self._sums = stamp_ns, self._sums, {}
        found = [
            (of.alignment.residuals.design_effect, n)
            for n, of in enumerate(candidates)
            if of.alignment.residuals is not None
        ]
        if found:
            self._add(candidates[sorted(found)[len(found) // 2][1]])
        for candidate in candidates:
            residuals, node = candidate.alignment.residuals, candidate.earlier.node
            if residuals is None or residuals.cell_scores is None:
                continue
            scores = residuals.cell_scores
            self._own += float((scores**2).sum())
            self._sums[node] = scores
            if node in before:
                earlier = kept * before[node]
                self._repeated += float((scores * earlier).sum())
                self._sums[node] = scores + earlier

    def rescaled(self, candidate: PoseCandidate) -> Array:
        """Return the (6, 6) information of a registration by what the log's residuals show.

        All registrations are scaled alike. What their weights are relative to each other decides the path,
        and one that rests on something that moves has residuals of its own.
        """
        if candidate.alignment.residuals is None:
            return candidate.information
        return candidate.information / (self._usual_scale * self.repetition)

    @property
    def _usual_scale(self) -> float:
        """Median of the frames' scales; the list is in order, so that long logs need no sorting."""
        count = len(self._scales)
        return 0.5 * (self._scales[(count - 1) // 2] + self._scales[count // 2])

    def _add(self, candidate: PoseCandidate) -> None:
        """Add a frame's registration: its residuals, and by how much they scale its covariance."""
        alignment = candidate.alignment
        assert alignment.residuals is not None
        assert alignment.information is not None  # it converged
        self._residuals.add(alignment.residuals)
        by_weights = alignment.information * alignment.residuals.variance_factor
        shown = self._residuals.rescaled(by_weights, alignment.T_target_source)
        (_, before), (_, after) = np.linalg.slogdet(candidate.information), np.linalg.slogdet(shown)
        insort(self._scales, math.exp((before - after) / len(shown)))
