"""Clouds prepared for registration: one point per voxel, surface normals, a search tree."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Points32
from mapper.core.geometry import Array, Points
from mapper.core.voxel_grid import voxel_means
from mapper.core.voxel_index import HALF_SPAN
from mapper.registration.kd_tree import KdTree, kd_tree

_NEIGHBOURS = 10
_FEWEST_NEIGHBOURS = 5
_NO_LINE = 0.1
"""Product of the two variances in a plane over the square of their sum: 0 on a line, 0.25 all around."""
_LINE = 1e-12
"""Least squared length of a normal before it is normalised, relative to the spread's; points on a line have
none."""


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """Prepared cloud: downsampled, ready for either side of any number of registrations.

    Attributes:
        normals: (N, 3) unit normals towards the origin; zero where there are too few neighbours.
        voxel_m: Edge of the voxels, metres.
        neighbours: Number of points that each normal is fitted to.
        tree: Search tree of the points; None without points.
        is_planar: All points have one z.
    """

    normals: Array
    voxel_m: float
    neighbours: int
    tree: KdTree | None
    is_planar: bool = False

    @property
    def points(self) -> Points:
        """(N, 3) means of the points in each occupied voxel, metres."""
        return np.empty((0, 3)) if self.tree is None else self.tree.points

    def near_normals(self) -> Array:
        """Return the (N, 3) normals that fit the nearer half of the neighbours."""
        nearer = max(_FEWEST_NEIGHBOURS, min(self.neighbours, len(self.points)) // 2)
        return np.empty((0, 3)) if self.tree is None else _normals(self.tree, nearer, self.is_planar)

    def nearest(self, points: Points) -> tuple[NDArray[np.int64], Array]:
        """Return the indices of the prepared points nearest to (M, 3) points, and their distances, metres."""
        if self.tree is None:
            return np.zeros(len(points), np.int64), np.full(len(points), np.inf)
        return self.tree.nearest(points)


def prepared(
    points: Points32 | Points, *, voxel_m: float, neighbours: int = _NEIGHBOURS, is_planar: bool = False
) -> Prepared:
    """Return a cloud with one point per voxel, its normals and search tree.

    Args:
        points: (N, 3) finite positions, metres.
        voxel_m: Edge of the voxels, metres.
        neighbours: Nearest points, itself included, that give each normal.
        is_planar: All points have one z; normals then lie in their plane, and are those of the lines through
            half as many neighbours.

    Raises:
        DataError: A point lies more than 2²⁰ voxels from the origin.
    """
    if len(points) == 0:
        return Prepared(np.empty((0, 3)), voxel_m, neighbours, None)
    farthest_m, limit_m = float(np.abs(points).max()), HALF_SPAN * voxel_m
    if farthest_m >= limit_m:
        raise DataError(
            f"cloud: a coordinate of {farthest_m:.0f} m is beyond {limit_m:.0f} m, the most at "
            f"{voxel_m} m voxels; move the cloud to the origin or enlarge voxel_m"
        )
    tree = kd_tree(voxel_means(points, voxel_m))
    if is_planar:  # points of a line have two neighbours at each distance, those of a surface more
        neighbours = max(_FEWEST_NEIGHBOURS, neighbours // 2)
    normals = _normals(tree, min(neighbours, len(tree.points)), is_planar)
    return Prepared(normals, voxel_m, neighbours, tree, is_planar)


def _normals(tree: KdTree, neighbours: int, is_planar: bool) -> Array:
    normals = np.zeros_like(tree.points)
    if _FEWEST_NEIGHBOURS <= neighbours <= len(tree.points):
        about, _ = tree.nearest_few(tree.points, neighbours)
        _fit_normals(tree.points, about, normals, is_planar)
    return normals


@njit(cache=True, nogil=True)
def _fit_normals(points, about, normals, is_planar):
    """Fill in the normals, towards the origin, of the planes that fit the points about each point best.

    Of points in a plane they are the lines' in it, as if these were walls as high as they are long; where the
    points are on no line, as at corners and at the far ends of a corridor, there is none.
    """
    count = about.shape[1]
    for i in range(len(points)):
        mx = my = mz = 0.0
        for j in about[i]:
            mx, my, mz = mx + points[j, 0], my + points[j, 1], mz + points[j, 2]
        mx, my, mz = mx / count, my / count, mz / count
        xx = xy = xz = yy = yz = zz = 0.0
        for j in about[i]:
            x, y, z = points[j, 0] - mx, points[j, 1] - my, points[j, 2] - mz
            xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
            yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
        if is_planar:
            zz = xx + yy
            if xx * yy - xy * xy > _NO_LINE * zz * zz:
                continue
        nx, ny, nz = _least_axis(xx, xy, xz, yy, yz, zz)
        sign = -1.0 if nx * points[i, 0] + ny * points[i, 1] + nz * points[i, 2] > 0.0 else 1.0
        normals[i, 0], normals[i, 1], normals[i, 2] = sign * nx, sign * ny, sign * nz


@njit(cache=True, nogil=True)
def _least_axis(xx, xy, xz, yy, yz, zz):
    """Return the unit eigenvector of a symmetric matrix's least eigenvalue (Smith 1961); 0 if it has none.

    The rows of the matrix less that eigenvalue span a plane: the eigenvector is normal to it, and the longest
    of their three cross products is the most accurate.
    """
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if spread == 0.0:
        return 0.0, 0.0, 0.0
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = min(max(determinant / (2.0 * spread**3), -1.0), 1.0)
    least = mean + 2.0 * spread * np.cos((np.arccos(cosine) + 2.0 * np.pi) / 3.0)
    a, b, c = xx - least, yy - least, zz - least
    x, y, z = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    square = x * x + y * y + z * z
    for u, v, w in (
        (xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz),
        (b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz),
    ):
        if u * u + v * v + w * w > square:
            x, y, z, square = u, v, w, u * u + v * v + w * w
    if square <= _LINE * spread**4:
        return 0.0, 0.0, 0.0
    length = np.sqrt(square)
    return x / length, y / length, z / length
