"""Detectors by OpenCV: ORB, SIFT and AKAZE."""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter
from typing import Generic, TypeVar

import cv2
import numpy as np

from mapper.core.frames import Image
from mapper.features.base import Descriptors, Features
from mapper.features.config import AkazeConfig, OrbConfig, SiftConfig

ORB_SCALE_FACTOR = 1.2
"""Size of a pixel on one level of ORB's pyramid relative to the next finer one, as published."""

_OCTAVE, _ANGLE, _RESPONSE = (attrgetter(name) for name in ("octave", "angle", "response"))

AnyConfig = TypeVar("AnyConfig", bound=OrbConfig | SiftConfig | AkazeConfig)


class _OpenCvDetector(Generic[AnyConfig]):
    """Detector of OpenCV with an adaptive threshold.

    OpenCV's own object is made anew for every image: it costs microseconds, and a shared one is not
    thread-safe.
    """

    scale_factor = 2.0

    def __init__(self, config: AnyConfig) -> None:
        self._config = config

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image; none where it has no texture."""
        config = self._config
        return until_enough(
            partial(self._attempt, gray),
            config.threshold,
            floor=config.min_threshold,
            want=config.enough_features,
        )

    @abstractmethod
    def _attempt(self, gray: Image, threshold: float) -> Features:
        """Return the features that a threshold leaves."""


class Orb(_OpenCvDetector[OrbConfig]):
    """ORB (Rublee, Rabaud, Konolige & Bradski 2011)."""

    scale_factor = ORB_SCALE_FACTOR

    def _attempt(self, gray: Image, threshold: float) -> Features:
        orb = cv2.ORB.create(
            nfeatures=self._config.max_features,
            scaleFactor=ORB_SCALE_FACTOR,
            nlevels=self._config.levels,
            fastThreshold=round(threshold),
        )
        keypoints, descriptors = orb.detectAndCompute(gray, None)
        return features_from(
            keypoints, descriptors, list(map(_OCTAVE, keypoints)), none=np.empty((0, 32), np.uint8)
        )


class Sift(_OpenCvDetector[SiftConfig]):
    """SIFT (Lowe 2004)."""

    def _attempt(self, gray: Image, threshold: float) -> Features:
        sift = cv2.SIFT.create(nfeatures=self._config.max_features, contrastThreshold=threshold)
        keypoints, descriptors = sift.detectAndCompute(gray, None)
        # The low byte is the octave; 255 is -1, the doubled image that SIFT starts from.
        octaves = [(k.octave + 1) & 0xFF for k in keypoints]
        features = features_from(keypoints, descriptors, octaves, none=np.empty((0, 128), np.float32))
        return strongest(features, self._config.max_features)


class Akaze(_OpenCvDetector[AkazeConfig]):
    """AKAZE (Alcantarilla, Nuevo & Bartoli 2013)."""

    def _attempt(self, gray: Image, threshold: float) -> Features:
        akaze = cv2.xfeatures2d.AKAZE.create(threshold=threshold)
        keypoints, descriptors = akaze.detectAndCompute(gray, None)
        features = features_from(
            keypoints, descriptors, list(map(_OCTAVE, keypoints)), none=np.empty((0, 61), np.uint8)
        )
        return strongest(features, self._config.max_features)


def until_enough(
    attempt: Callable[[float], Features], threshold: float, *, floor: float, want: int
) -> Features:
    """Detect with a threshold that is halved until there are enough features (Somlyai, PhD thesis, §4.1.2).

    Args:
        attempt: Returns the features at a given threshold; a lower one gives more.
        threshold: First threshold.
        floor: Last threshold.
        want: Number of features that is enough.
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
    """Return OpenCV's key points as arrays; ``none`` are the descriptors of an image without any."""
    n = len(keypoints)
    return Features(
        pixels=np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(n, 2),
        octave=np.array(octaves, np.int32),
        angle_rad=np.fromiter(map(_ANGLE, keypoints), np.float32, n) * np.float32(math.pi / 180.0),
        response=np.fromiter(map(_RESPONSE, keypoints), np.float32, n),
        descriptors=none if descriptors is None or n == 0 else descriptors,
    )
