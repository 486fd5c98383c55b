"""Residuals of a log's keyframes, which give the uncertainty of its poses."""

import math
from bisect import insort
from statistics import median

import numpy as np

from mapper.core.geometry import Array, Transform
from mapper.graph.noise import with_model_error
from mapper.registration.variance_factor import ResidualStatistics

_FEWEST = 5
"""With fewer keyframes, features have their own weights, with the whole model error."""
_NONE, _WHOLE = 1.0, 1.5
"""Design effects at which residuals show no model error, and all of it. Synthetic logs without errors of
calibration have 0.75 to 1.0, real and uncalibrated ones 1.5 to 2.3."""
_LEAST = 0.125
"""Share of the model error that is always added."""
USUAL_VARIANCE = 0.25
"""Variance of features as long as too few keyframes show it: real and synthetic logs have 0.1 to 0.35."""
_LEAST_VARIANCE = 0.15
"""Landmarks err as well, while a keyframe's residuals are those to its own."""
_LEAST_VARIANCE_FACTOR = 0.05
"""Simulated logs have 0.03 to 0.1, and fr1_xyz 0.35 to 0.45."""
_LEAST_DISPARITY_SIGMA = 1.0 / 3.0
"""Disparities are not taken as more certain than this share of a pixel's: logs of a simulated Kinect have
residuals of 0.15 to 0.5, with distortion of depth 0.3 to 1.6, and fr1_xyz has 1.5."""


class LogResiduals:
    """Medians of the keyframes' residual statistics.

    Errors of calibration, shutter and depth move neighbouring features alike, so residuals that depend on
    each other tell how much of such errors a log has.
    """

    def __init__(self, *, disparity_sigma: float = 1.0) -> None:
        """Start before the first keyframe.

        Args:
            disparity_sigma: Standard deviation of virtual disparities relative to that of a pixel, at most.
        """
        self.disparity_sigma = disparity_sigma
        """As the argument, but less where residuals of more than a few keyframes show it."""
        self._most_disparity_sigma = disparity_sigma
        self._disparity_ratios = [disparity_sigma**2] * _FEWEST  # as if so many keyframes had shown it
        self._factors: list[float] = []  # of the keyframes, in increasing order, as are the next
        self._effects: list[float] = []
        self._variances: list[float] = []
        self._factor = self._scale = 1.0  # of covariances, and of the model error

    def add(self, keyframe: ResidualStatistics) -> None:
        """Add a keyframe's."""
        insort(self._factors, float(keyframe.variance_factor))
        insort(self._effects, float(keyframe.design_effect))
        insort(self._variances, float(keyframe.variance))
        if len(self._factors) >= _FEWEST:
            self._factor = median(self._factors)
            self._scale = float(np.clip((median(self._effects) - _NONE) / (_WHOLE - _NONE), _LEAST, 1.0))

    def add_disparity_ratio(self, ratio: float) -> None:
        """Add a keyframe's variance of virtual disparities relative to that of its pixels."""
        insort(self._disparity_ratios, ratio)
        sigma = max(math.sqrt(median(self._disparity_ratios)), _LEAST_DISPARITY_SIGMA)
        self.disparity_sigma = min(sigma, self._most_disparity_sigma)

    @property
    def variance(self) -> float:
        """Usual square of a feature's residual, relative to what its weight says."""
        if len(self._variances) < _FEWEST:
            return USUAL_VARIANCE
        return float(np.clip(median(self._variances), _LEAST_VARIANCE, 1.0))

    @property
    def variance_factor(self) -> float:
        """Factor on features' variances that makes them those of a log's residuals, at most 1.

        Errors that neighbours share count for more, so that it is no outlier that the lens moves.
        """
        if len(self._factors) < _FEWEST:
            return USUAL_VARIANCE
        return float(np.clip(self._factor, _LEAST_VARIANCE_FACTOR, 1.0))

    def rescaled(self, information: Array, T_i_j: Transform) -> Array:
        """Return the (6, 6) information of a relative pose by what the residuals show.

        Args:
            information: (6, 6) from features whose errors are independent, and as large as their weights say.
            T_i_j: (4, 4) the measurement.
        """
        return with_model_error(information / self._factor, T_i_j, scale=self._scale)
