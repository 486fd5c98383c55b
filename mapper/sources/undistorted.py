"""Frames of lenses that five coefficients do not model, undistorted as they are read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Frame, PinholeCamera, RgbdFrame, Scan
from mapper.sources.base import ImageFiles, WrappedEntry
from mapper.sources.image_files.reading import scan_of

POLYNOMIAL_MODELS = frozenset({"plumb_bob", "brown_conrady", "rational_polynomial"})
"""Names of OpenCV's model of 4, 5, 8 (rational), 12 (thin prism) or 14 (tilted) coefficients."""
FISHEYE_MODELS = frozenset({"equidistant", "kannala_brandt", "kannala_brandt4", "fisheye"})
"""Names of the model of 4 coefficients of Kannala & Brandt (2006)."""
_COEFFICIENTS = {True: (4,), False: (4, 5, 8, 12, 14)}


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


@dataclass(frozen=True, slots=True)
class UndistortedEntry(WrappedEntry):
    """RGB-D frame of another lens as a pinhole camera would have taken it.

    Attributes:
        maps: Columns and rows in its images, as ``Lens.maps`` returns them.
    """

    maps: tuple[NDArray[np.float32], NDArray[np.float32]]

    @property
    def files(self) -> ImageFiles | None:
        """None: the encoded images are distorted."""
        return None

    def load(self, *, colour: bool = True) -> Frame:
        """Read the frame, with the nearest depth for each pixel, for means lie beside edges.

        Raises:
            FrameError: As the recorded frame.
        """
        frame = self.entry.load(colour=colour)
        if not isinstance(frame, RgbdFrame):
            return frame
        return replace(
            frame,
            image=cv2.remap(frame.image, *self.maps, cv2.INTER_LINEAR),
            depth_m=cv2.remap(frame.depth_m, *self.maps, cv2.INTER_NEAREST),
        )

    def scan(self) -> Scan:
        """Read the depth alone.

        Raises:
            FrameError: As ``load``.
        """
        frame = self.load(colour=False)
        if isinstance(frame, RgbdFrame):
            return scan_of(frame.depth_m, frame.camera, stamp_ns=frame.stamp_ns)
        return frame
