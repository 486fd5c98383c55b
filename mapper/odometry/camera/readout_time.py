"""Readout time of a rolling shutter, estimated from a log."""

import numpy as np

_PRIOR_S = 0.01
"""Standard deviation of the readout time before anything is measured, about its mean of 0: global shutter."""
_MIN_SIGMAS = 5.0
"""Estimates that deviate less from 0, in standard deviations, are taken for a global shutter's."""
_STEP_S = 0.0005
"""Smaller changes of the estimate are not applied."""
_MAX_READOUT_S = 0.04
_KEPT = 0.95
"""Share of the information that is kept at each window: later ones have better poses and fewer outliers."""


class ReadoutTime:
    """Readout time of a rolling shutter: the time from the first line's exposure to the last line's.

    It is one more unknown of every local bundle adjustment, after the poses and points are eliminated
    (Hedborg et al. 2012 adjust the motion within each image; here it is known from tracking, and the readout
    time is what is sought). The windows overlap, which ``windows_sharing`` allows for.
    """

    def __init__(self, given_s: float | None, *, windows_sharing: int) -> None:
        """Start at a given readout time, or at 0 if it is to be estimated.

        Args:
            given_s: Seconds; negative if lines are read from the bottom, or from the right of upright images.
                None estimates it.
            windows_sharing: Number of windows that an observation takes part in.
        """
        self.seconds = given_s or 0.0
        self.is_estimated = given_s is None
        self._windows_sharing = windows_sharing
        self._information = _PRIOR_S**-2
        self._weighted_s = 0.0

    def describe(self, size_px: tuple[int, int]) -> str:
        """Return the estimate in words; empty if there is none, or all lines are read at once.

        Args:
            size_px: Width and height of the images.
        """
        if not self.is_estimated or self.seconds == 0.0:
            return ""
        is_upright = size_px[0] < size_px[1]
        lines, *ends = ("columns", "left", "right") if is_upright else ("rows", "top", "bottom")
        begin = ends[self.seconds < 0.0]
        return (
            f"rolling shutter: {lines} are read within {1e3 * abs(self.seconds):.0f} ms from the {begin}, as "
            "estimated from the log; odometry.readout_s sets it"
        )

    def learn(self, information: float, gradient: float) -> None:
        """Add a window's measurement.

        Args:
            information: s⁻² that its observations hold, poses and points eliminated.
            gradient: Of half their χ² with respect to the readout time, s⁻¹, at ``seconds``.
        """
        if not self.is_estimated or information <= 0.0:
            return
        share = 1.0 / self._windows_sharing
        self._information = _KEPT * self._information + (1.0 - _KEPT) * _PRIOR_S**-2 + share * information
        self._weighted_s = _KEPT * self._weighted_s + share * (information * self.seconds - gradient)
        estimate_s = self._weighted_s / self._information
        if abs(estimate_s) * np.sqrt(self._information) < _MIN_SIGMAS:
            estimate_s = 0.0
        if abs(estimate_s - self.seconds) >= _STEP_S:
            self.seconds = float(np.clip(estimate_s, -_MAX_READOUT_S, _MAX_READOUT_S))
