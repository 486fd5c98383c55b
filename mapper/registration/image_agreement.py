"""Agreement of two whole RGB-D images under a motion: surfaces at the same depth that look alike."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image, RgbdFrame, ray_table
from mapper.core.geometry import Transform, apply
from mapper.sensing.config import KINECT_NOISE
from mapper.sensing.depth import depth_sigma_m

_ROWS = 120
"""Rows of the pixels that are compared."""
_MIN_DEPTH_M = 0.2
_SIGMAS, _SHARE, _LEAST_M = 3.0, 0.06, 0.03
"""Depths are the same within this multiple of their sigma, this share of the depth, which an error
of the motion by a degree gives at grazing incidence, and this distance."""
_BLUR = 0.5
"""Standard deviation of the blur, in pixels of the image with the coarser view."""
_LOCAL, _NOISE_LEVELS = 0.05, 2.0
"""Standard deviation of the window about each pixel over which grey levels are normalised, in heights of the
coarser view, and grey levels of noise, which do not count as contrast."""
_MIN_POINTS = 300
"""With fewer pixels nothing is compared: an object may look like another."""


@dataclass(frozen=True, slots=True)
class ImageAgreement:
    """Agreement of the pixels of one image with another one, where both see the same part of the scene.

    Attributes:
        compared: Number of pixels that fall into the other image, where that measured a depth.
        points: Number of those on surfaces that the other image shows at the same depth.
        same_ratio: Their share of the compared ones.
        through_ratio: Share of the pixels in space that the other image sees through.
        correlation: Correlation of the grey levels on the same surfaces, −1 … 1.
        local_correlation: The same of grey levels without their local mean, in local standard deviations:
            light and one poster of high contrast do not outweigh the rest.
    """

    compared: int
    points: int
    same_ratio: float
    through_ratio: float
    correlation: float
    local_correlation: float


NOTHING_COMPARED = ImageAgreement(0, 0, 0.0, 0.0, 0.0, 0.0)
"""Agreement of images that share next to no view."""


def image_agreement(i: RgbdFrame, j: RgbdFrame, T_j_i: Transform) -> ImageAgreement:
    """Return how image i agrees with image j.

    Args:
        i: First frame.
        j: Second frame.
        T_j_i: (4, 4) pose of the first camera in the second.
    """
    step = max(i.camera.height_px // _ROWS, 1)
    z_i = i.depth_m[::step, ::step].astype(np.float64)
    measured = z_i > 0.0
    z_i = z_i[measured]
    rays = ray_table(i.camera)[::step, ::step][measured].astype(np.float64)
    points_j = apply(T_j_i, np.column_stack([rays * z_i[:, None], z_i]))
    in_front = np.flatnonzero(points_j[:, 2] > _MIN_DEPTH_M)
    pixels = j.camera.distort(j.camera.project(points_j[in_front])) if len(in_front) else np.empty((0, 2))
    seen = (pixels > -0.5).all(axis=1) & (
        pixels < np.array([j.camera.width_px, j.camera.height_px]) - 0.5
    ).all(axis=1)
    columns, rows = np.rint(pixels[seen]).astype(np.intp).T
    z_j = j.depth_m[rows, columns].astype(np.float64)
    known = z_j > 0.0
    chosen, columns, rows, z_j = in_front[seen][known], columns[known], rows[known], z_j[known]
    if len(chosen) < _MIN_POINTS:
        return NOTHING_COMPARED
    predicted, z_i = points_j[chosen, 2], z_i[chosen]
    deepest = np.maximum(predicted, z_i)
    limit = _LEAST_M + _SHARE * predicted + _SIGMAS * depth_sigma_m(KINECT_NOISE, deepest)
    same = np.abs(z_j - predicted) < limit
    zoom = float(np.median(predicted / z_i))  # pixels of i in one of j
    greys = _blurred(i.gray, zoom), _blurred(j.gray, 1.0 / zoom)
    details = (_normalised(grey, z) for grey, z in zip(greys, (zoom, 1.0 / zoom), strict=True))
    correlations = [
        _correlation(of_i[::step, ::step][measured][chosen[same]], of_j[rows[same], columns[same]])
        for of_i, of_j in (greys, details)
    ]
    return ImageAgreement(
        len(chosen),
        int(same.sum()),
        float(same.mean()),
        float((z_j - predicted >= limit).mean()),
        *correlations,
    )


def _blurred(grey: Image, zoom: float) -> Image:
    """Return an image as another one of larger pixels shows it."""
    return grey if zoom <= 1.0 else np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR * zoom), np.uint8)


def _normalised(grey: Image, zoom: float) -> NDArray[np.float32]:
    """Return grey levels less their local mean, in local standard deviations."""
    levels = grey.astype(np.float32)
    sigma_px = _LOCAL * grey.shape[0] * max(zoom, 1.0)
    detail = levels - cv2.GaussianBlur(levels, (0, 0), sigma_px)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), sigma_px)) + _NOISE_LEVELS
    return np.asarray(detail / spread, np.float32)


def _correlation(a: NDArray[Any], b: NDArray[Any]) -> float:
    a, b = a.astype(np.float64), b.astype(np.float64)
    if len(a) < _MIN_POINTS or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])
