"""Coloured cloud: one averaged point per voxel, in memory that grows with the scene, not with the log."""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Points32
from mapper.core.voxel_index import AXIS_BITS, cell_key, claim_row, voxel_index

Colors = NDArray[np.uint8]
"""(N, 3) uint8 RGB."""

_HALF_SPAN = 1 << (AXIS_BITS - 1)  # voxels on either side of the world's origin
_BATCH = 1 << 16  # points added at once: bounds the memory reserved ahead of need
_LOWEST_LEVEL = 30.0  # of 255: where the palette of heights begins
_SUMS = 7  # x, y, z, red, green, blue, count


class CloudBuilder:
    """Builder of a cloud whose points are the mean position and mean colour of the points in each voxel.

    Memory is about 72 bytes a voxel and does not depend on the number of points added.
    """

    def __init__(self, voxel_m: float) -> None:
        """Start empty.

        Args:
            voxel_m: Edge of a voxel, metres.

        Raises:
            DataError: The edge is not a positive number.
        """
        if not 0.0 < voxel_m < np.inf:
            raise DataError(f"cloud: voxel of {voxel_m} m; want a finite edge > 0")
        self.voxel_m = voxel_m
        self._size = 0
        self._sums = np.empty((_BATCH, _SUMS))
        self._index = voxel_index(_BATCH)

    def __len__(self) -> int:
        """Return the number of voxels with a point."""
        return self._size

    def add(self, points_world: Points32, colors: Colors) -> None:
        """Add a cloud.

        Args:
            points_world: (N, 3) float32 metres, world frame.
            colors: (N, 3) uint8 RGB.

        Raises:
            DataError: Shapes that differ, a coordinate that is not finite, or one beyond the key range.
        """
        if points_world.ndim != 2 or points_world.shape[1] != 3 or colors.shape != points_world.shape:
            raise DataError(
                f"cloud: points {points_world.shape} and colors {colors.shape}, want two of (N, 3)"
            )
        if len(points_world) == 0:
            return
        reach_m = max(float(points_world.max()), -float(points_world.min()))
        limit_m = (_HALF_SPAN - 1) * self.voxel_m
        if not reach_m <= limit_m:  # also refuses NaN
            raise DataError(
                f"cloud: a coordinate of {reach_m} m; {self.voxel_m} m voxels reach {limit_m:.0f} m, "
                "drop the point or enlarge the voxel"
            )
        for first in range(0, len(points_world), _BATCH):
            batch = slice(first, first + _BATCH)
            self._reserve(_BATCH)
            self._size = _fold(
                points_world[batch],
                colors[batch],
                1.0 / self.voxel_m,
                self._index,
                self._sums,
                self._size,
            )

    def points_and_colors(self) -> tuple[Points32, Colors]:
        """Return (M, 3) float32 mean positions and (M, 3) uint8 mean colours, in order of first points."""
        sums = self._sums[: self._size]
        means = sums[:, :6] / sums[:, 6:]
        return means[:, :3].astype(np.float32), np.rint(means[:, 3:]).astype(np.uint8)

    def _reserve(self, more: int) -> None:
        need = self._size + more
        if need > len(self._sums):
            spare = max(need, 3 * len(self._sums) // 2) - len(self._sums)
            self._sums = np.concatenate([self._sums, np.empty((spare, _SUMS))])
            self._index = voxel_index(len(self._sums), self._index.keys[: self._size])


@njit(cache=True, nogil=True)
def _fold(points, colors, voxels_per_m, index, sums, size):  # type: ignore[no-untyped-def]
    """Add each point to its voxel's sums; return the number of voxels."""
    last_key, voxel = np.int64(-1), np.int64(-1)
    for i in range(len(points)):
        key = cell_key(points[i, 0] * voxels_per_m, points[i, 1] * voxels_per_m, points[i, 2] * voxels_per_m)
        if key != last_key:  # neighbouring pixels mostly share a voxel, and queries of the index cost most
            voxel = claim_row(index, key, size)
            if voxel == size:
                sums[size] = 0.0
                size += 1
            last_key = key
        for axis in range(3):
            sums[voxel, axis] += points[i, axis]
            sums[voxel, 3 + axis] += colors[i, axis]
        sums[voxel, 6] += 1.0
    return size


def height_colors(
    heights_m: NDArray[np.floating], *, between_m: tuple[float, float] | None = None
) -> NDArray[np.uint8]:
    """Return (N, 3) uint8 RGB for (N,) heights, from dark violet to yellow.

    The palette is Viridis (Smith & van der Walt 2015), which people who see no difference of red and green
    read too, without its darkest tenth, which would not be seen on the dark ground of a viewer.

    Args:
        heights_m: (N,) heights in any frame.
        between_m: Heights of the first and of the last colour; None is the 2nd and the 98th percentile.
    """
    if len(heights_m) == 0:
        return np.empty((0, 3), np.uint8)
    low, high = between_m or np.percentile(heights_m, [2.0, 98.0])
    share = np.clip((heights_m - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    levels = np.rint(_LOWEST_LEVEL + (255.0 - _LOWEST_LEVEL) * share).astype(np.uint8).reshape(-1, 1)
    bgr = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(bgr.reshape(-1, 3)[:, ::-1], dtype=np.uint8)
