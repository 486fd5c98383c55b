"""Free-space check of two scans: no obstacle of one scan may stand where rays of the other passed.

Points that coincide are weak evidence of a motion: any ground lies on any other, and the walls of one street
on those of the next. An obstacle nearer than every return that the other scan has in its direction
contradicts the motion.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy import float32, int64
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array, Transform, inverse

MARGIN_RATIO = 0.01
"""Share of the range that is added to the margin: what an error of the rotation adds, and a range's noise."""
DIRECTION_RAD = 0.0175
"""Resolution of range images where nothing else is stated: one degree."""
MIN_RETURNS = 3
"""Number of the nine directions around a point that need a return for the point to contradict: where the
range image has fewer, it has holes."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanDescription:
    """Points and rays of one scan.

    Attributes:
        T_level_body: (4, 4) from the body frame to the level frame.
        points_level: (M, 3) float32 metres, level frame: the points to be checked, its obstacles or its
            ground.
        ranges_m: (elevations, azimuths) float32 range image, body axes: the least range in each direction
            from ``origin_body``, +inf without a return.
        direction_rad: Edge of a pixel of the range image.
        origin_body: (3,) metres, body frame: where the rays begin.
    """

    T_level_body: Transform
    points_level: Points32
    ranges_m: NDArray[np.float32]
    direction_rad: float
    origin_body: Array


@dataclass(frozen=True, slots=True)
class FreeSpaceCounts:
    """Points of one scan, compared with the rays of another.

    Attributes:
        points: Number of points.
        agreeing: Number of points on a surface that the other scan measured.
        contradicting: Number of points in space that the other scan's rays passed. The remaining points are
            hidden behind surfaces, or in directions without returns.
    """

    points: int
    agreeing: int
    contradicting: int

    @property
    def visible(self) -> int:
        """Number of points that either agree or contradict."""
        return self.agreeing + self.contradicting

    @property
    def agreeing_ratio(self) -> float:
        """Share of all points that agree."""
        return self.agreeing / max(self.points, 1)

    @property
    def contradicting_ratio(self) -> float:
        """Share of all points that contradict."""
        return self.contradicting / max(self.points, 1)

    @property
    def visible_contradicting_ratio(self) -> float:
        """Share of the visible points that contradict."""
        return self.contradicting / max(self.visible, 1)


@dataclass(frozen=True, slots=True)
class FreeSpaceResult:
    """Result of a free-space check.

    Attributes:
        source: The source's points, compared with the target's rays.
        target: The target's points, compared with the source's rays.
    """

    source: FreeSpaceCounts
    target: FreeSpaceCounts


@dataclass(frozen=True, slots=True)
class FreeSpaceCheck:
    """Free-space check of two scans under a motion between them.

    Attributes:
        margin_m: A point agrees with a surface this near to it along the ray, and contradicts when it is
            nearer than all surfaces by more. ``MARGIN_RATIO`` of the range is added.
    """

    margin_m: float

    def compare(
        self, target: ScanDescription, source: ScanDescription, T_target_source: Transform
    ) -> FreeSpaceResult:
        """Return how the points of each scan fit the rays of the other.

        Args:
            target: One scan.
            source: The other.
            T_target_source: (4, 4) motion between their body frames.
        """
        T_target_level = T_target_source @ inverse(source.T_level_body)
        T_source_level = inverse(T_target_source) @ inverse(target.T_level_body)
        return FreeSpaceResult(
            source=self.count(target, source.points_level, T_target_level),
            target=self.count(source, target.points_level, T_source_level),
        )

    def count(self, scan: ScanDescription, points: Points32, T_body_points: Transform) -> FreeSpaceCounts:
        """Return how points fit the rays of a scan.

        Args:
            scan: The scan.
            points: (N, 3) float32 metres.
            T_body_points: (4, 4) from the points' frame to the scan's body frame.
        """
        agreeing, contradicting = _classify(
            scan.ranges_m,
            scan.origin_body,
            points,
            T_body_points,
            scan.direction_rad,
            self.margin_m,
        )
        return FreeSpaceCounts(len(points), agreeing, contradicting)


@njit(cache=True, nogil=True)
def range_image(points, origin, direction_rad):
    """Return (elevations, azimuths) float32: the least range of the points in each direction from the origin.

    Directions without a point hold +inf. Rows begin straight down, columns behind.

    Args:
        points: (N, 3) metres.
        origin: (3,) metres.
        direction_rad: Edge of a pixel.
    """
    rows, columns = int64(np.ceil(np.pi / direction_rad)), int64(np.ceil(2.0 * np.pi / direction_rad))
    ranges = np.full((rows, columns), np.inf, float32)
    for n in range(len(points)):
        x, y, z = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        row, column, range_m = _pixel_of(x, y, z, ranges.shape, direction_rad)
        ranges[row, column] = min(ranges[row, column], range_m)
    return ranges


@njit(cache=True, nogil=True)
def _pixel_of(x, y, z, shape, direction_rad):
    """Return the row and column of a point relative to a range image's origin, and the point's range."""
    across = np.sqrt(x * x + y * y)
    row = min(int64((np.arctan2(z, across) + 0.5 * np.pi) / direction_rad), shape[0] - 1)
    column = min(int64((np.arctan2(y, x) + np.pi) / direction_rad), shape[1] - 1)
    return row, column, np.sqrt(across * across + z * z)


@njit(cache=True, nogil=True)
def _classify(ranges, origin, points, T, direction_rad, margin_m):
    """Return how many points, moved by T, agree with a range image, and how many contradict it."""
    rows, columns = ranges.shape
    agreeing = contradicting = 0
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3] - origin[0]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3] - origin[1]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3] - origin[2]
        row, column, range_m = _pixel_of(x, y, z, ranges.shape, direction_rad)
        nearest, gap, returns = np.inf, np.inf, 0
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(column - 1, column + 2):
                surface = ranges[i, j % columns]
                returns += surface < np.inf
                nearest = min(nearest, surface)
                gap = min(gap, abs(surface - range_m))
        margin = margin_m + MARGIN_RATIO * range_m
        if gap <= margin:
            agreeing += 1
        elif range_m < nearest - margin and returns >= MIN_RETURNS:
            contradicting += 1
    return agreeing, contradicting
