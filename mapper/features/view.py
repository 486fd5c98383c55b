"""What a place looked like from one pose: the features by which it is recognised and measured again."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points, Transform
from mapper.features.detectors import Descriptors
from mapper.features.windowed import Words, pack

_ORB_BYTES = 32


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The features of one frame with their 3D points.

    Attributes:
        stamp_ns: The frame's stamp.
        pixels: (N, 2) undistorted pixels.
        sigma_px: (N,) how far from its true place a feature's pixel may lie: one σ.
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
        return self.descriptors.dtype == np.uint8 and self.descriptors.shape[1] == _ORB_BYTES

    @property
    def bits(self) -> Words:
        """(N, 4) uint64 descriptors.

        Raises:
            DataError: They are not 256 bits each.
        """
        if not self.is_orb:
            raise DataError(
                f"view {self.stamp_ns}: descriptors are {self.descriptors.shape[1]} × "
                f"{self.descriptors.dtype}, want 256 bits; choose detector 'orb' or 'uniform-orb'"
            )
        return pack(self.descriptors)

    def has_depth(self, *, max_depth_m: float) -> NDArray[np.bool_]:
        """Return (N,) which features have depth up to a limit."""
        near: NDArray[np.bool_] = self.points_camera[:, 2] <= max_depth_m
        return near
