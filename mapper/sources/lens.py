"""Lenses that five coefficients do not model, whose images are undistorted as they are read."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import PinholeCamera

POLYNOMIAL_MODELS = frozenset({"plumb_bob", "brown_conrady", "radtan", "rational_polynomial"})
"""Names of OpenCV's model of 4, 5, 8 (rational), 12 (thin prism) or 14 (tilted) coefficients."""
FISHEYE_MODELS = frozenset({"equidistant", "kannala_brandt", "kannala_brandt4", "fisheye"})
"""Names of the model of 4 coefficients of Kannala & Brandt (2006)."""
_COEFFICIENTS = {True: (4,), False: (4, 5, 8, 12, 14)}
COEFFICIENTS_TEXT = "5, 8, 12 or 14 as OpenCV orders them, or 4 of an equidistant lens"


def lens_model(name: str, coefficients: int) -> str:
    """Return a lens model's name as it is in the sets above, whatever its spelling.

    No name is OpenCV's model where the number of coefficients is none of the fisheyes'.
    """
    spelled = re.sub(r"[^a-z0-9]+", "_", name.strip().lower())
    is_opencv = spelled in ("", "none") and coefficients in _COEFFICIENTS[False]
    return "rational_polynomial" if is_opencv and coefficients not in _COEFFICIENTS[True] else spelled


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """Distortion of a lens.

    Attributes:
        model: Name in the log's words.
        coefficients: As OpenCV orders those of the model.
    """

    model: str
    coefficients: Sequence[float]

    @property
    def is_fisheye(self) -> bool:
        """Whether the coefficients are of angles, not of their tangents."""
        return self.model in FISHEYE_MODELS

    @property
    def is_known(self) -> bool:
        """Whether images can be freed of it."""
        names = FISHEYE_MODELS if self.is_fisheye else POLYNOMIAL_MODELS
        return self.model in names and len(self.coefficients) in _COEFFICIENTS[self.is_fisheye]

    def maps(self, camera: PinholeCamera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return for each pixel of the camera, (H, W) each, the column and row that it has in the image."""
        size_px, coefficients = (camera.width_px, camera.height_px), np.array(self.coefficients)
        unturned = np.eye(3)
        undistort = cv2.fisheye.initUndistortRectifyMap if self.is_fisheye else cv2.initUndistortRectifyMap
        columns, rows = undistort(camera.matrix, coefficients, unturned, camera.matrix, size_px, cv2.CV_32FC1)
        return columns, rows

    def rays(self, camera: PinholeCamera) -> NDArray[np.float32]:
        """Return the (H, W, 2) undistorted x/z and y/z of every pixel's ray of a camera with the lens."""
        columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
        pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)[:, np.newaxis]
        undistort = cv2.fisheye.undistortPoints if self.is_fisheye else cv2.undistortPoints
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
        rays = np.asarray(undistort(pixels, camera.matrix, np.array(self.coefficients), criteria=criteria))
        return rays.astype(np.float32).reshape(camera.height_px, camera.width_px, 2)
