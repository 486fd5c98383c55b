"""Map of Gaussians, one per cell, to which scans are aligned: voxelised GICP (Koide et al. 2021)."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, is_rigid
from mapper.core.voxel_index import VoxelIndex, cell_key, claim_row, row_of, voxel_index
from mapper.registration.gauss_newton import FLATNESS, add_pair, gauss_newton_step, inverse_of, move, turn
from mapper.registration.surfaces import Prepared

_CLEAR_CYCLE = 10


class GaussianCells:
    """Map of Gaussians: the mean and the mean covariance of the points in each cell.

    Every tenth cloud, cells that no recent cloud has touched are removed.
    """

    def __init__(self, cell_m: float, *, kept_clouds: int) -> None:
        """Make an empty map.

        Args:
            cell_m: Edge of the cells, metres.
            kept_clouds: Number of clouds for which a cell is kept that none of them touches.
        """
        self.cell_m = cell_m
        self._kept_clouds = kept_clouds
        self._clouds = self._count = 0
        self._cells = _room_for(1)

    def __len__(self) -> int:
        """Return the number of cells."""
        return self._count

    def insert(self, cloud: Prepared, T_world_cloud: Transform) -> None:
        """Add a cloud at its pose."""
        capacity = len(self._cells.sums)
        while capacity < self._count + len(cloud.points):
            capacity *= 2
        if capacity > len(self._cells.sums):
            self._keep(np.arange(self._count), capacity)
        self._clouds += 1
        self._count = _insert(
            *self._cells, self._count, self._clouds, self.cell_m, cloud.points, cloud.normals, T_world_cloud
        )
        if self._clouds % _CLEAR_CYCLE == 0:
            touched = self._cells.touched[: self._count]
            self._keep(np.flatnonzero(touched + self._kept_clouds >= self._clouds), capacity)

    def align(
        self,
        cloud: Prepared,
        T_world_cloud: Transform,
        *,
        max_iterations: int,
        step_rad: float,
        step_m: float,
    ) -> Transform | None:
        """Return T_world_cloud from a guess; None if no point lies in any cell.

        Args:
            cloud: The cloud.
            T_world_cloud: (4, 4) guess.
            max_iterations: Largest number of steps.
            step_rad: A step that turns less and
            step_m: moves less than this is the last.
        """
        T_found, pairs = _descend(
            self._cells.numbers,
            self._cells.gaussians,
            self.cell_m,
            cloud.points,
            cloud.normals,
            T_world_cloud,
            max_iterations,
            np.array([step_rad, step_m]),
        )
        return T_found if pairs > 0 and is_rigid(T_found) else None

    def _keep(self, kept: NDArray[np.intp], capacity: int) -> None:
        """Keep some cells, in tables of another capacity."""
        before, self._count = self._cells, len(kept)
        self._cells = _room_for(capacity, before.numbers.keys[kept])
        for now, then in zip(self._cells[1:], before[1:], strict=True):
            now[: len(kept)] = then[kept]


class _Cells(NamedTuple):
    """Cells in the order in which they were met.

    Attributes:
        numbers: Index of the cells' numbers by their keys.
        sums: (C, 10) of positions, of covariances (xx, xy, xz, yy, yz, zz) and of ones.
        gaussians: (C, 9) the same sums as means.
        touched: (C,) number of the last cloud that had a point in them.
    """

    numbers: VoxelIndex
    sums: Array
    gaussians: Array
    touched: NDArray[np.int64]


def _room_for(capacity: int, keys: NDArray[np.int64] | None = None) -> _Cells:
    """Return room for cells, of which the first have these keys."""
    return _Cells(
        voxel_index(capacity, keys),
        np.zeros((capacity, 10)),
        np.zeros((capacity, 9)),
        np.zeros(capacity, np.int64),
    )


@njit(cache=True, nogil=True)
def _insert(numbers, sums, gaussians, touched, count, cloud, cell_m, points, normals, T):
    """Add points and their surfaces' covariances to their cells; return the number of cells."""
    p, m = np.empty(3), np.empty(3)
    for i in range(len(points)):
        move(T, points[i], p)
        turn(T, normals[i], m)
        cell, k = claim_row(numbers, cell_key(p[0] / cell_m, p[1] / cell_m, p[2] / cell_m), count), 3
        count += cell == count
        for row in range(3):
            sums[cell, row] += p[row]
            for column in range(row, 3):
                sums[cell, k] += (1.0 if row == column else 0.0) - FLATNESS * m[row] * m[column]
                k += 1
        sums[cell, 9] += 1.0
        touched[cell] = cloud
        for k in range(9):
            gaussians[cell, k] = sums[cell, k] / sums[cell, 9]
    return count


@njit(cache=True, nogil=True)
def _descend(numbers, gaussians, cell_m, points, normals, T, iterations, steps):
    """Return T_world_source after Gauss–Newton on points and their cells' Gaussians, and the number of pairs.

    Points farther from the mean of their cell than its edge are left out.
    """
    p, m, pairs = np.empty(3), np.empty(3), 0
    for _ in range(iterations):
        sums, pairs = np.zeros(27), 0
        for i in range(len(points)):
            move(T, points[i], p)
            cell = row_of(numbers, cell_key(p[0] / cell_m, p[1] / cell_m, p[2] / cell_m))
            if cell < 0:
                continue
            mean_and_covariance = gaussians[cell]
            x = mean_and_covariance[0] - p[0]
            y = mean_and_covariance[1] - p[1]
            z = mean_and_covariance[2] - p[2]
            if x * x + y * y + z * z > cell_m * cell_m:
                continue
            pairs += 1
            turn(T, normals[i], m)
            weight = inverse_of(
                mean_and_covariance[3] + 1.0 - FLATNESS * m[0] * m[0],
                mean_and_covariance[4] - FLATNESS * m[0] * m[1],
                mean_and_covariance[5] - FLATNESS * m[0] * m[2],
                mean_and_covariance[6] + 1.0 - FLATNESS * m[1] * m[1],
                mean_and_covariance[7] - FLATNESS * m[1] * m[2],
                mean_and_covariance[8] + 1.0 - FLATNESS * m[2] * m[2],
            )
            add_pair(sums, T, p, x, y, z, weight)
        T, is_last = gauss_newton_step(sums, pairs, T, steps)
        if is_last:
            break
    return T, pairs
