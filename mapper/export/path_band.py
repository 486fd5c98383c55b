"""Uncertainty and doubt of a path in pictures from above: a band around it, and the doubtful stretches."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.export.palette import ESTIMATE

SIGMAS = 2.0
"""Half the band's width, in standard deviations: in one direction 95 % of the errors lie within."""

_LONGER_SIDE_PX = 1000
_ALPHA = 60


def band_image(positions: Array, half_widths_m: Array, *, low: Array, high: Array) -> NDArray[np.uint8]:
    """Return an RGBA image, row 0 lowest, of a band of varying width around a path.

    Args:
        positions: (N, 2) or (N, 3) metres.
        half_widths_m: (N,); where one is NaN the band is interrupted.
        low: (2,) metres, the image's lower corner.
        high: (2,) metres, its upper corner.
    """
    pixel_m = float((high - low).max()) / _LONGER_SIDE_PX
    width, height = np.ceil((high - low) / pixel_m).astype(int)
    mask = np.zeros((max(height, 1), max(width, 1)), np.uint8)
    places = np.rint((positions[:, :2] - low) / pixel_m - 0.5).astype(np.int32)
    radii = np.maximum(half_widths_m / pixel_m, 1.0)
    known = np.isfinite(half_widths_m)
    for index in np.flatnonzero(known).tolist():
        radius = float(radii[index])
        cv2.circle(mask, places[index].tolist(), round(radius), _ALPHA, thickness=-1)
        if index and known[index - 1]:
            thickness = max(1, round(radius + float(radii[index - 1])))
            cv2.line(mask, places[index - 1].tolist(), places[index].tolist(), _ALPHA, thickness)
    return np.dstack([np.broadcast_to(np.array(ESTIMATE, np.uint8), (*mask.shape, 3)), mask])
