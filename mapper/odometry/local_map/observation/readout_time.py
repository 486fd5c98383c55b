"""Readout time of a rolling shutter, estimated from a log."""

import numpy as np

_PRIOR_S = 0.01
"""Standard deviation of the readout time before anything is measured, about its mean of 0: global shutter."""
_MIN_SIGMAS = 5.0
"""Estimates that deviate less from 0, in standard deviations, are taken for a global shutter's."""
_STEP_S = 0.0005
"""Smaller changes of the estimate are not applied."""
_MAX_READOUT_S = 0.04


class ReadoutTime:
    """Readout time of a rolling shutter: the time from the first row's exposure to the last row's.

    It is one more unknown of every local bundle adjustment, after the poses and points are eliminated
    (Hedborg et al. 2012 adjust the motion within each image; here it is known from tracking, and the readout
    time is what is sought). The windows overlap, which ``windows_sharing`` allows for. The estimate
    tends to be too short: the motion within an image, which is refined by it, makes up for the rest.
    """

    def __init__(self, given_s: float | None, *, windows_sharing: int, windows_counted: int = 20) -> None:
        """Start at a given readout time, or at 0 if it is to be estimated.

        Args:
            given_s: Seconds; negative if rows are read from the bottom. None estimates it.
            windows_sharing: Number of windows that an observation takes part in.
            windows_counted: Number of windows that the estimate is from: later ones have better poses and
                fewer outliers.
        """
        self.seconds = given_s or 0.0
        self.is_estimated = given_s is None
        self._windows_sharing = windows_sharing
        self._kept = 1.0 - 1.0 / windows_counted
        self._information = _PRIOR_S**-2
        self._weighted_s = 0.0

    @property
    def sentence(self) -> str:
        """The estimate in words; empty if there is none, or all rows are read at once."""
        if not self.is_estimated or self.seconds == 0.0:
            return ""
        begin, readout_ms = "top" if self.seconds > 0.0 else "bottom", 1e3 * abs(self.seconds)
        return (
            f"rolling shutter: rows are read within at least {readout_ms:.0f} ms from the {begin}, as "
            "estimated from the log; odometry.readout_s sets it"
        )

    def learn(self, information: float, gradient: float) -> None:
        """Add a window's measurement.

        Args:
            information: s⁻² of its observations, poses and points eliminated.
            gradient: Of half their χ² with respect to the readout time, s⁻¹, at ``seconds``.
        """
        if not self.is_estimated or information <= 0.0:
            return
        share = 1.0 / self._windows_sharing
        kept = self._kept
        self._information = kept * self._information + (1.0 - kept) * _PRIOR_S**-2 + share * information
        self._weighted_s = kept * self._weighted_s + share * (information * self.seconds - gradient)
        estimate_s = self._weighted_s / self._information
        if abs(estimate_s) * np.sqrt(self._information) < _MIN_SIGMAS:
            estimate_s = 0.0
        if abs(estimate_s - self.seconds) >= _STEP_S:
            self.seconds = float(np.clip(estimate_s, -_MAX_READOUT_S, _MAX_READOUT_S))
