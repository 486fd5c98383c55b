"""Features on the outline of something nearer, whose depth may be that of the background."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import DepthImage
from mapper.core.geometry import Array

_REACH_SIGMAS = 2.0
"""How far a feature may be from the outline that it lies on, in σ of its pixel."""
_MIN_JUMP = 0.1
"""Jump of the inverse depth, relative to that of the feature: more than noise of depth, up to 0.06."""


def lies_behind_edge(
    depth_m: DepthImage, columns: NDArray[np.intp], rows: NDArray[np.intp], sigma_px: Array
) -> NDArray[np.bool_]:
    """Return (N,) which features have something nearer so close by that they may lie on its outline.

    A corner of an outline moves with what is nearer, but its pixel may show the depth of what is behind. By
    that depth it moves too far, as all such features do: they bias the motion to one side.

    Args:
        depth_m: (H, W) depth image, 0 is no measurement.
        columns: (N,) pixels of the features.
        rows: (N,).
        sigma_px: (N,) standard deviation of a feature's pixel.
    """
    reach_px = np.maximum(np.rint(_REACH_SIGMAS * sigma_px), 1.0).astype(np.intp)
    return np.asarray(_behind_edge(depth_m, columns, rows, reach_px, _MIN_JUMP))


@njit(cache=True, nogil=True)
def _behind_edge(
    depth_m: DepthImage,
    columns: NDArray[np.intp],
    rows: NDArray[np.intp],
    reach_px: NDArray[np.intp],
    min_jump: float,
) -> NDArray[np.bool_]:
    found = np.zeros(len(columns), np.bool_)
    for n in range(len(columns)):
        found[n] = _has_nearer(depth_m, columns[n], rows[n], reach_px[n], min_jump)
    return found


@njit(cache=True, nogil=True)
def _has_nearer(depth_m: DepthImage, column: int, row: int, reach_px: int, min_jump: float) -> bool:
    """Return whether the depth jumps to something nearer within reach of a pixel, along axes and diagonals.

    Inverse depth is affine on a plane: what it grows by on one side, it falls by on the other.
    """
    here = _inverse_depth(depth_m, column, row)
    if here == 0.0:
        return False
    for step in range(1, reach_px + 1):
        for right, down in ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)):
            rise = _inverse_depth(depth_m, column + step * right, row + step * down) - here
            if rise <= min_jump * here:
                continue
            opposite = _inverse_depth(depth_m, column - step * right, row - step * down)
            slope = max(here - opposite, 0.0) if opposite > 0.0 else 0.0
            if rise - slope > min_jump * here:
                return True
    return False


@njit(cache=True, nogil=True)
def _inverse_depth(depth_m: DepthImage, column: int, row: int) -> float:
    """Return the inverse depth of a pixel, 1/m; 0 without one."""
    height, width = depth_m.shape
    if 0 <= row < height and 0 <= column < width and depth_m[row, column] > 0.0:
        return float(1.0 / depth_m[row, column])
    return 0.0
