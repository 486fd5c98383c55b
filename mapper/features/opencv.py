"""The detectors that OpenCV brings: ORB, SIFT and AKAZE."""

import math
from collections.abc import Callable, Sequence
from operator import attrgetter

import cv2
import numpy as np

from mapper.core.frames import Image
from mapper.features.config import AkazeConfig, OrbConfig, SiftConfig
from mapper.features.detectors import Descriptors, Features

_OCTAVE, _ANGLE, _RESPONSE = (attrgetter(name) for name in ("octave", "angle", "response"))

# Detector objects are made anew for every image: it costs microseconds, and shared ones are not thread-safe.


class Orb:
    """ORB (Rublee et al. 2011)."""

    def __init__(self, config: OrbConfig) -> None:
        self._config = config

    @property
    def scale_factor(self) -> float:
        """How much larger a pixel gets from one octave to the next."""
        return self._config.scale_factor

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image; none where it has no texture."""
        config = self._config

        def attempt(threshold: float) -> Features:
            orb = cv2.ORB.create(
                nfeatures=config.max_features,
                scaleFactor=config.scale_factor,
                nlevels=config.levels,
                fastThreshold=round(threshold),
            )
            keypoints, descriptors = orb.detectAndCompute(gray, None)
            return features_from(
                keypoints, descriptors, list(map(_OCTAVE, keypoints)), none=np.empty((0, 32), np.uint8)
            )

        return until_enough(attempt, config.threshold, floor=config.min_threshold, want=config.min_features)


class Sift:
    """SIFT (Lowe 2004)."""

    scale_factor = 2.0

    def __init__(self, config: SiftConfig) -> None:
        self._config = config

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image; none where it has no texture."""
        config = self._config

        def attempt(threshold: float) -> Features:
            sift = cv2.SIFT.create(nfeatures=config.max_features, contrastThreshold=threshold)
            keypoints, descriptors = sift.detectAndCompute(gray, None)
            # The low byte is the octave; 255 is -1, the doubled image that SIFT starts from.
            octaves = [(k.octave + 1) & 0xFF for k in keypoints]
            return strongest(
                features_from(keypoints, descriptors, octaves, none=np.empty((0, 128), np.float32)),
                config.max_features,
            )

        return until_enough(attempt, config.threshold, floor=config.min_threshold, want=config.min_features)


class Akaze:
    """AKAZE (Alcantarilla et al. 2013)."""

    scale_factor = 2.0

    def __init__(self, config: AkazeConfig) -> None:
        self._config = config

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image; none where it has no texture."""
        config = self._config

        def attempt(threshold: float) -> Features:
            akaze = cv2.xfeatures2d.AKAZE.create(threshold=threshold)
            keypoints, descriptors = akaze.detectAndCompute(gray, None)
            features = features_from(
                keypoints, descriptors, list(map(_OCTAVE, keypoints)), none=np.empty((0, 61), np.uint8)
            )
            return strongest(features, config.max_features)

        return until_enough(attempt, config.threshold, floor=config.min_threshold, want=config.min_features)


def until_enough(
    attempt: Callable[[float], Features], threshold: float, *, floor: float, want: int
) -> Features:
    """Detect with a threshold that halves until there are enough features (thesis §4.1.2).

    Args:
        attempt: Detects with a given threshold; a lower one finds more.
        threshold: Where to start.
        floor: The last threshold to try.
        want: How many features are enough.
    """
    features = attempt(threshold)
    while len(features) < want and threshold > floor:
        threshold = max(0.5 * threshold, floor)
        features = attempt(threshold)
    return features


def strongest(features: Features, count: int) -> Features:
    """Return the features of highest response, at most ``count``, in the order they came."""
    if len(features) <= count:
        return features
    kept = np.sort(np.argsort(-features.response, kind="stable")[:count])
    return Features(
        features.pixels[kept],
        features.octave[kept],
        features.angle_rad[kept],
        features.response[kept],
        features.descriptors[kept],
    )


def features_from(
    keypoints: Sequence[cv2.KeyPoint],
    descriptors: Descriptors | None,
    octaves: list[int],
    *,
    none: Descriptors,
) -> Features:
    """Return OpenCV's keypoints as arrays; ``none`` stands for the descriptors where there are none."""
    if descriptors is None or len(keypoints) == 0:
        return Features(
            np.empty((0, 2), np.float32),
            np.empty(0, np.int32),
            np.empty(0, np.float32),
            np.empty(0, np.float32),
            none,
        )
    n = len(keypoints)
    return Features(
        pixels=np.asarray(cv2.KeyPoint.convert(keypoints), np.float32),
        octave=np.array(octaves, np.int32),
        angle_rad=np.fromiter(map(_ANGLE, keypoints), np.float32, n) * np.float32(math.pi / 180.0),
        response=np.fromiter(map(_RESPONSE, keypoints), np.float32, n),
        descriptors=descriptors,
    )
