"""SURF features (Bay, Ess, Tuytelaars & Van Gool 2008), compiled."""

import numpy as np

from mapper.core.frames import Image
from mapper.features.base import Features
from mapper.features.config import SurfConfig
from mapper.features.fast_hessian import interest_points
from mapper.features.surf_descriptor import describe, orientations

_SIZE_OF_OCTAVE_0 = 18.0  # pixels, between the filters of 15 and 21 in which its points are found


class Surf:
    """SURF detector with 64 numbers a feature and OpenCV's scale of the threshold.

    No release of OpenCV on PyPI contains its own SURF for a current Python; this one agrees with it to
    hundredths of a pixel and degrees (``tests/features/test_surf.py``).
    """

    scale_factor = 2.0

    def __init__(self, config: SurfConfig) -> None:
        self._config = config

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image, strongest first; none where it has no texture."""
        config = self._config
        points = interest_points(
            gray, octaves=config.octaves, layers=config.layers, threshold=config.min_threshold
        )
        points = points[np.argsort(-points[:, 3], kind="stable")]
        threshold = config.threshold
        while threshold > config.min_threshold and (points[:, 3] >= threshold).sum() < config.enough_features:
            threshold *= 0.5
        points = points[points[:, 3] >= max(threshold, config.min_threshold)][: config.max_features]
        angles_rad = orientations(gray, points)
        return Features(
            pixels=points[:, :2].copy(),
            octave=np.rint(np.log2(points[:, 2] / _SIZE_OF_OCTAVE_0)).clip(0.0).astype(np.int32),
            angle_rad=angles_rad,
            response=points[:, 3].copy(),
            descriptors=describe(gray, points, angles_rad),
        )
