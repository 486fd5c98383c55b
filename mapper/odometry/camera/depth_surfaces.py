"""Surfaces of a depth image: its mean inverse depth in square cells, and planes fitted to these."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import DepthImage, PinholeCamera
from mapper.core.geometry import Array, Points
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig
from mapper.sensing.depth import depth_sigma_m

_COLUMNS = 80
_SAMPLES = 4
"""Rows and columns read of a cell: neighbouring pixels of a large depth image have the same error."""
_MAX_DEPTH_RANGE = 0.15
"""A cell with a larger range of depth, relative to its least, lies on an edge and has no surface."""
_REACH_CELLS = 2
_MIN_CELLS = 12
_SAME_SURFACE = 0.08
_MAX_VARIANCE_RATIO = 6.0
"""Residual variance of a fit, relative to the image's median, from which the cells are on no one plane."""
_LATERAL_SIGMA_PX = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class DepthCells:
    """A depth image as means over square cells: small enough to be kept with every keyframe.

    Attributes:
        inverse_depth: (R, C) float32 mean of 1 / z, per metre; 0 where there is no surface.
        cell_px: Edge of a cell.
        camera: Intrinsics of the image.
    """

    inverse_depth: NDArray[np.float32]
    cell_px: int
    camera: PinholeCamera

    @property
    def rays(self) -> Array:
        """(R, C, 2) undistorted x/z and y/z of the cells' middles, camera frame."""
        return _rays_of(self.camera, self.cell_px)

    def points(self) -> Points:
        """Return the (N, 3) points of the cells that have a surface, camera frame."""
        known = self.inverse_depth > 0.0
        z = 1.0 / self.inverse_depth[known].astype(np.float64)
        return np.column_stack([self.rays[known] * z[:, np.newaxis], z])


@dataclass(frozen=True, slots=True, eq=False)
class DepthSurface:
    """Planes of a depth image's cells, to which other images can be aligned.

    Attributes:
        cells: The depth image.
        planes: (R, C, 4) n and h of the plane n · x = h through each cell, camera frame: the unit normal
            points away from the camera; all 0 where there is none.
        normal_variance: Mean variance of the normals in one direction, rad².
    """

    cells: DepthCells
    planes: Array
    normal_variance: float

    def normals(self) -> Array:
        """Return the (N, 3) normals of the points of the cells, 0 where there is none."""
        normals: Array = self.planes[self.cells.inverse_depth > 0.0, :3]
        return normals


def depth_cells(depth_m: DepthImage, camera: PinholeCamera) -> DepthCells:
    """Return a depth image as means over square cells, 80 in a row.

    Args:
        depth_m: (H, W) metres; 0 is no measurement.
        camera: Its intrinsics.
    """
    cell_px = max(camera.width_px // _COLUMNS, 1)
    inverse_depth = np.zeros((camera.height_px // cell_px, camera.width_px // cell_px), np.float32)
    _average(depth_m, cell_px, max(cell_px // _SAMPLES, 1), np.float32(1.0 + _MAX_DEPTH_RANGE), inverse_depth)
    return DepthCells(inverse_depth, cell_px, camera)


def surface_of(cells: DepthCells) -> DepthSurface:
    """Return the planes that fit the 5 × 5 cells about each cell, as far as these lie on one surface.

    The inverse depth of a plane is linear in x/z and y/z, and the noise of a triangulating sensor is the same
    everywhere in it (Khoshelham & Elberink 2012, eq. 10), so that least squares weigh every cell alike.
    """
    planes, variances = np.zeros((*cells.inverse_depth.shape, 4)), np.zeros((*cells.inverse_depth.shape, 2))
    _fit_planes(
        cells.inverse_depth.astype(np.float64),
        cells.rays,
        _REACH_CELLS,
        _MIN_CELLS,
        _SAME_SURFACE,
        planes,
        variances,
    )
    residual, turning = variances[..., 0], variances[..., 1]
    if residual.any():
        planes[residual > _MAX_VARIANCE_RATIO * np.median(residual[residual > 0.0])] = 0.0
    fitted = planes[..., 3] > 0.0
    return DepthSurface(cells, planes, float(turning[fitted].mean()) if fitted.any() else 0.0)


def point_sigmas(cells: DepthCells, points: Points, noise: DepthNoiseConfig | None) -> Array:
    """Return (N, 2) standard deviations of the cells' points: of their depth and across their ray, metres."""
    z = points[:, 2]
    across_m = _LATERAL_SIGMA_PX / cells.camera.fx_px * z
    return np.column_stack([depth_sigma_m(noise or KINECT_NOISE, z), across_m])


@lru_cache(maxsize=8)
def _rays_of(camera: PinholeCamera, cell_px: int) -> Array:
    rows, columns = camera.height_px // cell_px, camera.width_px // cell_px
    middle = 0.5 * (cell_px - 1)
    x, y = np.meshgrid(np.arange(columns) * cell_px + middle, np.arange(rows) * cell_px + middle)
    ideal = camera.undistort(np.column_stack([x.ravel(), y.ravel()]))
    rays: Array = (ideal - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
    return rays.reshape(rows, columns, 2)


@njit(cache=True, nogil=True, error_model="numpy")
def _average(depth_m, cell_px, sample_px, max_ratio, inverse_depth):
    """Fill in the mean inverse depth of the cells that are measured for the most part, and not on an edge."""
    rows, columns = inverse_depth.shape
    samples = len(range(0, cell_px, sample_px)) ** 2
    for row in range(rows):
        for column in range(columns):
            least, largest, total, count = np.float32(np.inf), np.float32(0.0), np.float32(0.0), 0
            for y in range(row * cell_px, (row + 1) * cell_px, sample_px):
                for x in range(column * cell_px, (column + 1) * cell_px, sample_px):
                    z = depth_m[y, x]
                    if z > np.float32(0.0):
                        least, largest = min(least, z), max(largest, z)
                        total += np.float32(1.0) / z
                        count += 1
            if 2 * count > samples and largest <= max_ratio * least:
                inverse_depth[row, column] = total / np.float32(count)


@njit(cache=True, nogil=True)
def _fit_planes(inverse_depth, rays, reach, min_cells, same_surface, planes, variances):
    """Fill in the planes 1 / z = a · x/z + b · y/z + c about each cell, with their variances."""
    rows, columns = inverse_depth.shape
    for row in range(reach, rows - reach):
        for column in range(reach, columns - reach):
            here = inverse_depth[row, column]
            if here == 0.0:
                continue
            u0, v0 = rays[row, column, 0], rays[row, column, 1]
            n = su = sv = suu = suv = svv = sd = sud = svd = sdd = 0.0
            for y in range(row - reach, row + reach + 1):
                for x in range(column - reach, column + reach + 1):
                    d = inverse_depth[y, x]
                    if d == 0.0 or abs(d - here) > same_surface * here:
                        continue
                    u, v, d = rays[y, x, 0] - u0, rays[y, x, 1] - v0, d - here
                    n, su, sv, sd = n + 1.0, su + u, sv + v, sd + d
                    suu, suv, svv = suu + u * u, suv + u * v, svv + v * v
                    sud, svd, sdd = sud + u * d, svd + v * d, sdd + d * d
            if n < min_cells:
                continue
            suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
            sud, svd = sud - su * sd / n, svd - sv * sd / n
            determinant = suu * svv - suv * suv
            if determinant <= 0.05 * suu * svv:
                continue
            a, b = (sud * svv - svd * suv) / determinant, (svd * suu - sud * suv) / determinant
            variance = (sdd - sd * sd / n - a * sud - b * svd) / (n - 3.0)
            c = here + (sd - a * su - b * sv) / n - a * u0 - b * v0
            length = np.sqrt(a * a + b * b + c * c)
            planes[row, column, 0], planes[row, column, 1] = a / length, b / length
            planes[row, column, 2], planes[row, column, 3] = c / length, 1.0 / length
            variances[row, column, 0] = variance
            variances[row, column, 1] = 0.5 * variance * (suu + svv) / determinant / (length * length)
