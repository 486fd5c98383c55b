"""All textures of a scene in one flat array of mip-maps (Williams 1983), and where they are on the boxes."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.core.geometry import Array

LEVELS = 8


class Atlas(NamedTuple):
    """Textures and their successive halvings, as plain arrays for compiled code.

    Attributes:
        texels: (T, 3) uint8 RGB, level after level, row after row.
        starts: (N, LEVELS) int64: where each level's first texel lies.
        heights_px: (N, LEVELS) int64.
        widths_px: (N, LEVELS) int64.
    """

    texels: NDArray[np.uint8]
    starts: NDArray[np.int64]
    heights_px: NDArray[np.int64]
    widths_px: NDArray[np.int64]


class Faces(NamedTuple):
    """Affine texture maps of N boxes' faces: texel = scale · metres from the face's top left + offset.

    Attributes:
        textures: (N, 6) int64 index in the atlas.
        scales: (N, 6, 2) float64 texels per metre along columns and rows.
        offsets: (N, 6, 2) float64 texels.
        shades: (N, 6) float64 brightness.
    """

    textures: NDArray[np.int64]
    scales: Array
    offsets: Array
    shades: Array


def build_atlas(images: Sequence[Image]) -> Atlas:
    """Return the mip-maps of (H, W, 3) uint8 images; each level averages 2×2 texels of the one before."""
    parts: list[NDArray[np.uint8]] = []
    starts, heights, widths = (np.zeros((len(images), LEVELS), dtype=np.int64) for _ in range(3))
    start = 0
    for i, image in enumerate(images):
        level: Image = image
        for k in range(LEVELS):
            if k > 0:
                size = (max(level.shape[1] // 2, 1), max(level.shape[0] // 2, 1))
                level = np.asarray(cv2.resize(level, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            starts[i, k], heights[i, k], widths[i, k] = start, *level.shape[:2]
            parts.append(level.reshape(-1, 3))
            start += level.shape[0] * level.shape[1]
    return Atlas(np.concatenate(parts), starts, heights, widths)
