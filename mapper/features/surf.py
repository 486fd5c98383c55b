"""SURF features: key points of our own detector, described by mahotas."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.features.base import Features
from mapper.features.config import SurfConfig
from mapper.features.fast_hessian import interest_points

_DIMENSIONS = 64
_SCALE_OF_OCTAVE_0 = 2.4  # σ between those of its two inner layers, filters of 15 and 21 px
_REACH_SCALES = 16.0  # mahotas drops points whose descriptor would leave the image


class Surf:
    """SURF detector (Bay, Ess, Tuytelaars & Van Gool 2008).

    mahotas only describes the points: up to its release 1.4.18 its own interpolated key points
    lie on the wrong side of the sampled maximum, 0.5 px off on average and more in coarse octaves.
    """

    scale_factor = 2.0

    def __init__(self, config: SurfConfig) -> None:
        self._config = config

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image; none where it has no texture."""
        from mahotas.features import surf  # takes half a second to import

        config = self._config
        points = interest_points(gray, config.octaves, config.min_threshold)
        points = points[_describable(points, gray.shape)]
        points = points[np.argsort(-points[:, 3], kind="stable")]
        threshold = config.threshold
        while threshold > config.min_threshold and (points[:, 3] >= threshold).sum() < config.min_features:
            threshold *= 0.5
        points = points[points[:, 3] >= max(threshold, config.min_threshold)][: config.max_features]
        if len(points) == 0:
            return _features(np.empty((0, 6 + _DIMENSIONS)))
        integral = surf.integral(gray.astype(np.float64))
        return _features(surf.descriptors(integral, points[:, :5].copy(), is_integral=True))


def _describable(points: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which points are far enough from the border."""
    to_border_px = np.minimum(points[:, :2], np.array(shape) - points[:, :2]).min(axis=1)
    inside: NDArray[np.bool_] = to_border_px > _REACH_SCALES * points[:, 2]
    return inside


def _features(rows: NDArray[np.float64]) -> Features:
    """Return mahotas's rows (y, x, scale, score, laplacian, angle, 64 numbers) as features."""
    octave = np.rint(np.log2(rows[:, 2] / _SCALE_OF_OCTAVE_0)).clip(0.0)
    return Features(
        pixels=np.ascontiguousarray(rows[:, 1::-1][:, :2], dtype=np.float32),
        octave=octave.astype(np.int32),
        angle_rad=rows[:, 5].astype(np.float32),
        response=rows[:, 3].astype(np.float32),
        descriptors=np.ascontiguousarray(rows[:, 6:], dtype=np.float32),
    )
