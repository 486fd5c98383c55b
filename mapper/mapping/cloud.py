"""Coloured cloud: one averaged point per voxel, in memory that grows with the scene, not with the log."""

from dataclasses import replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Cloud
from mapper.core.geometry import stride_for
from mapper.core.voxel_index import HALF_SPAN, cell_key, cell_of, claim_row, voxel_index
from mapper.octree.sparse_grid import GROWTH

Real = TypeVar("Real", bound="np.floating[Any]")

Colors = NDArray[np.uint8]
"""(N, 3) uint8 RGB."""

MOST_TO_VIEW = 5_000_000
"""Largest number of points of a cloud that is made to be looked at."""

_ALL, _GREY = np.empty(0, np.bool_), 128
_NO_INTENSITIES, _NO_SUMS = np.empty(0, np.float32), np.empty((0, 1), np.float32)
_BATCH = 65_536  # points added at once: bounds the memory reserved ahead of need
_LOWEST_LEVEL = 30.0  # of 255: where the palette of heights begins


class CloudBuilder:
    """Builder of a cloud whose points are the mean position, colour and intensity of those in each voxel.

    Memory is about 64 bytes a voxel and does not depend on the number of points added: positions are summed
    as offsets from the voxel's centre, for which single precision does.
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
        self._offsets = np.zeros((_BATCH, 3), np.float32)  # sums, in voxels
        self._counts = np.zeros((_BATCH, 5), np.uint32)  # sums of R, G and B; numbers of points and colours
        self._intensities: NDArray[np.float32] | None = None  # sums, where every point has one
        self._seen_s: list[tuple[int, float]] = []  # voxels that are new with a cloud, and its time
        self._index = voxel_index(_BATCH)

    def __len__(self) -> int:
        """Return the number of voxels with a point."""
        return self._size

    @property
    def coloured_share(self) -> float:
        """Share of the voxels with a point that has a colour."""
        return float((self._counts[: self._size, 4] > 0).mean()) if self._size else 0.0

    def add(self, cloud: Cloud, time_s: float = 0.0, *, has_color: NDArray[np.bool_] | None = None) -> None:
        """Add a cloud; intensities are kept where all clouds have them.

        Args:
            cloud: The cloud.
            has_color: (N,) which of its points have a colour; None are all. Voxels without any are grey.
            time_s: When it was seen.

        Raises:
            DataError: Shapes that differ, a coordinate that is not finite, or one beyond the key range.
        """
        points_world, colors, intensities = cloud.points, cloud.colors, cloud.intensities
        if points_world.ndim != 2 or points_world.shape[1] != 3 or colors.shape != points_world.shape:
            raise DataError(
                f"cloud: points {points_world.shape} and colors {colors.shape}, want two of (N, 3)"
            )
        if len(points_world) == 0:
            return
        reach_m = max(float(points_world.max()), -float(points_world.min()))
        limit_m = (HALF_SPAN - 1) * self.voxel_m
        if not reach_m <= limit_m:  # also refuses NaN
            raise DataError(
                f"cloud: a coordinate of {reach_m} m; {self.voxel_m} m voxels reach {limit_m:.0f} m, "
                "drop the point or enlarge the voxel"
            )
        if self._size == 0 and intensities is not None:
            self._intensities = np.zeros((len(self._offsets), 1), np.float32)
        if intensities is None:
            self._intensities = None
        before = self._size
        for first in range(0, len(points_world), _BATCH):
            batch = slice(first, first + _BATCH)
            self._reserve(_BATCH)
            self._size = _fold(
                points_world[batch],
                colors[batch],
                _ALL if has_color is None else has_color[batch],
                _NO_INTENSITIES if intensities is None else intensities[batch],
                1.0 / self.voxel_m,
                self._index,
                self._offsets,
                self._counts,
                _NO_SUMS if self._intensities is None else self._intensities,
                self._size,
            )
        self._seen_s.append((self._size - before, time_s))

    def cloud(self) -> Cloud:
        """Return the mean points, in the order and with the times of the first points in the voxels."""
        points, colors = np.empty((self._size, 3), np.float32), np.empty((self._size, 3), np.uint8)
        _fill_means(self._index.keys, self._offsets, self._counts, self.voxel_m, points, colors)
        new, seen_s = np.array(self._seen_s or [(0, 0.0)]).T
        cloud = Cloud(points, colors, times_s=np.repeat(seen_s, new.astype(int)).astype(np.float32))
        if self._intensities is None:
            return cloud
        counts = self._counts[: self._size, 3].astype(np.float32)
        return replace(cloud, intensities=self._intensities[: self._size, 0] / counts)

    def _reserve(self, more: int) -> None:
        need = self._size + more
        if need > len(self._offsets):
            rows = max(need, int(GROWTH * len(self._offsets)))
            for sums in (self._offsets, self._counts, self._intensities):
                if sums is not None:
                    sums.resize((rows, sums.shape[1]), refcheck=False)  # a copy would need both at once
            self._index = voxel_index(rows, self._index.keys[: self._size])


@njit(cache=True, nogil=True)
def _fold(points, colors, has_color, intensities, voxels_per_m, index, offsets, counts, intensity_sums, size):
    """Add each point to its voxel's sums; return the number of voxels."""
    last_key, voxel = np.int64(-1), np.int64(-1)
    for i in range(len(points)):
        x, y, z = points[i, 0] * voxels_per_m, points[i, 1] * voxels_per_m, points[i, 2] * voxels_per_m
        key = cell_key(x, y, z)
        if key != last_key:  # neighbouring pixels mostly share a voxel, and queries of the index cost most
            voxel = claim_row(index, key, size)
            if voxel == size:
                size += 1
            last_key = key
        offsets[voxel, 0] += x - np.floor(x) - 0.5
        offsets[voxel, 1] += y - np.floor(y) - 0.5
        offsets[voxel, 2] += z - np.floor(z) - 0.5
        counts[voxel, 3] += 1
        if len(has_color) == 0 or has_color[i]:
            for channel in range(3):
                counts[voxel, channel] += colors[i, channel]
            counts[voxel, 4] += 1
        if len(intensity_sums):
            intensity_sums[voxel, 0] += intensities[i]
    return size


@njit(cache=True, nogil=True)
def _fill_means(keys, offsets, counts, voxel_m, points, colors):
    """Fill in the mean position and colour of each voxel."""
    for row in range(len(points)):
        count, colored = float(counts[row, 3]), float(counts[row, 4])
        cell = cell_of(keys[row])
        for axis in range(3):
            points[row, axis] = (cell[axis] + 0.5 + offsets[row, axis] / count) * voxel_m
            colors[row, axis] = np.rint(counts[row, axis] / colored) if colored else _GREY


def thinned_to_view(points: NDArray[Real], colors: Colors) -> tuple[NDArray[Real], Colors]:
    """Return every n-th of (N, 3) points and their colours, few enough for a viewer or a picture."""
    step = stride_for(len(points), MOST_TO_VIEW)
    return points[::step], colors[::step]


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
