"""Residuals of a log's keyframes, which tell how certain its poses are."""

import numpy as np

from mapper.core.geometry import Array, Transform
from mapper.graph.noise import with_model_error
from mapper.registration.variance_factor import ResidualStatistics

_FEWEST = 5
"""With fewer keyframes, features count as their weights say, with the whole model error."""
_NONE, _WHOLE = 1.0, 1.5
"""Design effects at which residuals show no model error, and all of it. Synthetic logs without errors of
calibration have 0.75 to 1.0, real and uncalibrated ones 1.5 to 2.3."""
_LEAST = 0.125
"""Share of the model error that is always added."""


class LogResiduals:
    """Medians of the keyframes' residual statistics.

    Errors of calibration, shutter and depth move neighbouring features alike, so residuals that depend on
    each other tell how much of such errors a log has.
    """

    def __init__(self) -> None:
        self._keyframes: list[ResidualStatistics] = []
        self._factor = self._scale = 1.0  # of covariances, and of the model error

    def add(self, keyframe: ResidualStatistics) -> None:
        """Add a keyframe's."""
        self._keyframes.append(keyframe)
        if len(self._keyframes) >= _FEWEST:
            self._factor = float(np.median([known.variance_factor for known in self._keyframes]))
            effect = float(np.median([known.design_effect for known in self._keyframes]))
            self._scale = float(np.clip((effect - _NONE) / (_WHOLE - _NONE), _LEAST, 1.0))

    def honest(self, information: Array, T_i_j: Transform) -> Array:
        """Return the (6, 6) information of a relative pose by what the residuals show.

        Args:
            information: (6, 6) from features whose errors are independent, and as large as their weights say.
            T_i_j: (4, 4) the measurement.
        """
        return with_model_error(information / self._factor, T_i_j, scale=self._scale)
