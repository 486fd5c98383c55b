"""Photometric error of motions: how well the image before, seen from another pose, predicts an image."""

import math

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, inverse
from mapper.odometry.local_map.depth.depth_kernels import place_in_cells
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose

_LOCAL_CELLS = 2.0
"""Standard deviation of the window whose mean is taken out: exposures and shading change between images."""
_LIMIT_RATIO = 2.0
"""Limit of errors, relative to the median of the least: what moves by itself fits no motion."""
_MIN_COMPARED = 200
"""Cells that both images have to show."""


def excess_error(now: TrackedPose, before: TrackedPose, T_camera_world_other: Transform | None) -> float:
    """Return the photometric error that a tracked pose has beyond another pose's, in standard errors.

    The surfaces of the depth image are looked up in the image before (Steinbrücker, Sturm & Cremers 2011,
    eq. 3), and the differences of brightness are limited, as those of moving things tell of no camera's
    motion. 0 where too little is in both images.

    Args:
        now: The tracked pose.
        before: That of the image before.
        T_camera_world_other: (4, 4) the other pose of the image; None if there is none.
    """
    cells, grey = now.observation.depth_cells, now.observation.grey_cells
    cells_before, grey_before = before.observation.depth_cells, before.observation.grey_cells
    if T_camera_world_other is None or cells is None or cells_before is None:
        return 0.0
    if cells_before.camera != cells.camera or grey is None or grey_before is None:
        return 0.0
    errors = _differences(
        _without_local_mean(grey_before),
        _without_local_mean(grey),
        cells.inverse_depth,
        cells.rays,
        np.array([before.T_camera_world @ inverse(T) for T in (now.T_camera_world, T_camera_world_other)]),
        cells.camera.parameters,
        cells.cell_px,
    )
    errors = errors[:, ~np.isnan(errors).any(axis=0)]
    if errors.shape[1] < _MIN_COMPARED:
        return 0.0
    limit = _LIMIT_RATIO * np.median(errors.min(axis=0))
    found, other = np.minimum(errors, limit)
    excess = found - other
    spread = float(excess.std())
    return float(excess.mean()) * math.sqrt(len(excess)) / spread if spread > 0.0 else 0.0


def _without_local_mean(grey: NDArray[np.uint8]) -> Array:
    brightness = grey.astype(np.float64)
    local: Array = brightness - cv2.GaussianBlur(brightness, (0, 0), _LOCAL_CELLS)
    return local


@njit(cache=True, nogil=True)
def _differences(  # type: ignore[no-untyped-def]
    before, now, inverse_depth, rays, T_before_now, parameters, cell_px
):
    """Return (M, R · C) differences of brightness by M motions; NaN where one of the images shows nothing."""
    rows, columns = inverse_depth.shape
    differences = np.full((len(T_before_now), rows * columns), np.nan)
    point = np.empty(3)
    for row in range(rows):
        for column in range(columns):
            if inverse_depth[row, column] == 0.0:
                continue
            z = 1.0 / inverse_depth[row, column]
            point[0], point[1], point[2] = rays[row, column, 0] * z, rays[row, column, 1] * z, z
            for m in range(len(T_before_now)):
                down, across, _ = place_in_cells(T_before_now[m], point, parameters, cell_px)
                down, across = down - 0.5, across - 0.5  # from the first cell's middle
                if down < 0.0 or across < 0.0 or down >= rows - 1 or across >= columns - 1:
                    continue
                i, j = int(down), int(across)
                s, t = down - i, across - j
                upper = (1.0 - t) * before[i, j] + t * before[i, j + 1]
                lower = (1.0 - t) * before[i + 1, j] + t * before[i + 1, j + 1]
                seen = (1.0 - s) * upper + s * lower
                differences[m, row * columns + column] = abs(seen - now[row, column])
    return differences
