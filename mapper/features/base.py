"""Features of an image, and the interface of the detectors that find them."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Image

Descriptors = NDArray[np.uint8] | NDArray[np.float32]
"""(N, D) bits, compared by Hamming distance, or numbers, compared by Euclidean distance."""


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Key points of one image with their descriptors, one row each.

    Attributes:
        pixels: (N, 2) float32 column and row, pixels of the raw (distorted) image.
        octave: (N,) int32 pyramid level, 0 is the finest; one level up, a pixel is the detector's
            ``scale_factor`` larger.
        angle_rad: (N,) float32 orientation in the image, from the column axis towards the row axis.
        response: (N,) float32 strength, comparable within one detector only.
        descriptors: (N, D) uint8 bits (Hamming distance) or float32 (Euclidean distance).
    """

    pixels: NDArray[np.float32]
    octave: NDArray[np.int32]
    angle_rad: NDArray[np.float32]
    response: NDArray[np.float32]
    descriptors: Descriptors

    def __post_init__(self) -> None:
        n = len(self.pixels)
        shapes = (self.octave.shape, self.angle_rad.shape, self.response.shape)
        if self.pixels.shape != (n, 2) or shapes != ((n,),) * 3:
            raise DataError(
                f"features: pixels {self.pixels.shape} and columns {shapes}, want (N, 2) and (N,)"
            )
        if self.descriptors.ndim != 2 or len(self.descriptors) != n:
            raise DataError(f"features: descriptors {self.descriptors.shape}, want ({n}, D)")
        if self.descriptors.dtype not in (np.uint8, np.float32):
            raise DataError(f"features: descriptors are {self.descriptors.dtype}, want uint8 or float32")

    def __len__(self) -> int:
        return len(self.pixels)


@runtime_checkable
class Detector(Protocol):
    """Feature detector. Stateless: safe in any thread, and the result depends on the image alone."""

    @property
    def scale_factor(self) -> float:
        """Size of a pixel in one octave relative to the next finer one."""
        ...

    def detect(self, gray: Image) -> Features:
        """Return the features of an (H, W) uint8 image; none where it has no texture."""
        ...
