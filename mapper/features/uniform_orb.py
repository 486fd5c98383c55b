"""Uniform ORB: ORB features distributed evenly over the image."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.features.base import Descriptors, Features
from mapper.features.config import UniformOrbConfig
from mapper.features.hamming import ORB_BYTES
from mapper.features.opencv import ORB_SCALE_FACTOR
from mapper.features.uniform_orb_kernels import Pixels, corners, fast_scores, orientations, spread

_MARGIN_PX = 19  # reach of the rotated descriptor's tests
_PATCH_PX = 31


class UniformOrb:
    """Uniform ORB detector: oriented FAST corners of all pyramid levels, described by OpenCV's ORB.

    Zhao et al. 2020, §1.1, after Mur-Artal & Tardós 2017: FAST in cells with two thresholds, then one
    quadtree per level. A level's share of the features is proportional to its side length; what a coarse
    level cannot fill goes to the finer ones.
    """

    scale_factor = ORB_SCALE_FACTOR

    def __init__(self, config: UniformOrbConfig) -> None:
        self._config = config

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image; none where it has no texture."""
        levels = list(self._pyramid(gray))
        shares = np.power(ORB_SCALE_FACTOR, -np.arange(len(levels), dtype=np.float64))
        wanted = 0.0
        parts: list[Features] = []
        for octave in reversed(range(len(levels))):
            wanted += self._config.max_features * shares[octave] / shares.sum()
            part = self._features_of(levels[octave], octave, round(wanted), gray.shape)
            wanted -= len(part)
            parts.append(part)
        return _joined(parts[::-1])

    def _pyramid(self, gray: Image) -> Iterator[Image]:
        """Yield the image and its coarser levels, while they are large enough to hold a descriptor."""
        height, width = gray.shape
        level = gray
        for octave in range(self._config.levels):
            scale = ORB_SCALE_FACTOR**octave
            size = round(width / scale), round(height / scale)
            if octave:
                if min(size) <= 2 * _MARGIN_PX:
                    return
                level = cv2.resize(level, size, interpolation=cv2.INTER_LINEAR_EXACT)
            yield level

    def _features_of(self, level: Image, octave: int, wanted: int, shape: tuple[int, ...]) -> Features:
        """Return the features of a level of an image of that shape."""
        config = self._config
        scores = fast_scores(level, config.min_threshold, _MARGIN_PX)
        pixels, strength = corners(scores, config.threshold, config.cell_px, _MARGIN_PX)
        kept = spread(pixels, strength, level.shape[1], level.shape[0], wanted)
        pixels, strength = pixels[kept], strength[kept]
        angle_rad = orientations(level, pixels)
        # A level has whole pixels, so its size is not the image's by the scale factor: 0.4 px in its middle.
        pixel_px = np.array([shape[1] / level.shape[1], shape[0] / level.shape[0]])
        return Features(
            pixels=((pixels + 0.5) * pixel_px - 0.5).astype(np.float32),
            octave=np.full(len(pixels), octave, np.int32),
            angle_rad=angle_rad,
            response=strength.astype(np.float32),
            descriptors=_descriptors(level, pixels, angle_rad),
        )


def _descriptors(level: Image, pixels: Pixels, angle_rad: NDArray[np.float32]) -> Descriptors:
    keypoints = [
        cv2.KeyPoint(x, y, _PATCH_PX, angle)
        for (x, y), angle in zip(
            pixels.astype(np.float32).tolist(), np.degrees(angle_rad).tolist(), strict=True
        )
    ]
    if not keypoints:
        return np.empty((0, ORB_BYTES), np.uint8)
    # One level at a time, as OpenCV would build the pyramid again.
    orb = cv2.ORB.create(nlevels=1, edgeThreshold=_MARGIN_PX, patchSize=_PATCH_PX)
    return np.asarray(orb.compute(level, keypoints)[1])


def _joined(parts: list[Features]) -> Features:
    return Features(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.octave for part in parts]),
        np.concatenate([part.angle_rad for part in parts]),
        np.concatenate([part.response for part in parts]),
        np.concatenate([part.descriptors for part in parts]),
    )
