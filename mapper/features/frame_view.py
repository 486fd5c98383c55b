"""Views: the features or points of one frame by which a place is recognised and a loop is measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Points32
from mapper.core.geometry import Array, Points, Transform
from mapper.features.base import Descriptors
from mapper.features.hamming import ORB_BYTES
from mapper.runtime.archived import Archivable

if TYPE_CHECKING:
    from mapper.features.hamming import Bits


@dataclass(frozen=True, slots=True, eq=False)
class ImageView(Archivable):
    """The features of one RGB-D frame with their 3D points.

    Attributes:
        stamp_ns: The frame's stamp.
        pixels: (N, 2) undistorted pixels.
        sigma_px: (N,) standard deviation of a feature's pixel, along both axes.
        descriptors: (N, D) uint8 bits or float32.
        points_camera: (N, 3) metres; NaN without depth.
        intrinsics: (4,) fx, fy, cx, cy in pixels.
        T_body_camera: (4, 4) pose of the camera in the body frame.
    """

    stamp_ns: int
    pixels: Array
    sigma_px: Array
    descriptors: Descriptors
    points_camera: Points
    intrinsics: Array
    T_body_camera: Transform

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def is_orb(self) -> bool:
        """Descriptors are 256 bits each, as ORB's are."""
        return self.descriptors.dtype == np.uint8 and self.descriptors.shape[1] == ORB_BYTES

    @property
    def bits(self) -> Bits:
        """(N, 4) uint64 descriptors.

        Raises:
            DataError: They are not 256 bits each.
        """
        if not self.is_orb:
            raise DataError(
                f"view {self.stamp_ns}: descriptors are {self.descriptors.shape[1]} × "
                f"{self.descriptors.dtype}, want 256 bits; choose detector 'orb' or 'uniform-orb'"
            )
        from mapper.features.hamming import pack

        return pack(self.descriptors)

    def has_depth(self, *, max_depth_m: float) -> NDArray[np.bool_]:
        """Return (N,) which features have depth up to a limit."""
        return self.points_camera[:, 2] <= max_depth_m


@dataclass(frozen=True, slots=True, eq=False)
class ScanView:
    """The points of one scan, thinned and deskewed.

    Attributes:
        stamp_ns: The scan's stamp.
        points_body: (N, 3) float32 metres, body frame, z roughly up.
    """

    stamp_ns: int
    points_body: Points32


FrameView = ImageView | ScanView
