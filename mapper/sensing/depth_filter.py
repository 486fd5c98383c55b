"""DIF, the depth image filter of Somlyai (PhD thesis), alg. 4."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import DepthImage


def dif(depth_m: DepthImage) -> DepthImage:
    """Return the mean of the measured pixels in the 3×3 neighbourhood of every pixel, itself included.

    Zeros are no measurements and do not enter the mean, so edges of holes keep their depth and holes one
    pixel deep are filled; a pixel with no measurement around it stays 0.

    Args:
        depth_m: (H, W) float32 depth, metres; 0 is no measurement. At the border, which the thesis does not
            define, the part of the neighbourhood inside the image is used.

    Raises:
        DataError: The image is not (H, W) float32.
    """
    if depth_m.ndim != 2 or depth_m.dtype != np.float32:
        raise DataError(f"DIF: depth image of {depth_m.dtype} {depth_m.shape}, want (H, W) float32")
    filtered = np.empty_like(depth_m)
    if depth_m.size:
        _mean_3x3(np.ascontiguousarray(depth_m), filtered)
    return filtered


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_3x3(depth_m: NDArray[np.float32], filtered: NDArray[np.float32]) -> None:
    """Sum columns of three first, then three columns: six additions per pixel instead of sixteen."""
    height, width = depth_m.shape
    # A column of zeros on either side is "not measured" beyond the border.
    sums = np.zeros(width + 2, np.float32)
    counts = np.zeros(width + 2, np.float32)
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        sums[1:-1] = 0.0
        counts[1:-1] = 0.0
        for row in range(above, below + 1):
            for x in range(width):
                sums[x + 1] += depth_m[row, x]
                counts[x + 1] += np.float32(depth_m[row, x] > 0.0)
        for x in range(width):
            count = counts[x] + counts[x + 1] + counts[x + 2]
            total = sums[x] + sums[x + 1] + sums[x + 2]
            filtered[y, x] = total / max(count, np.float32(1.0))
