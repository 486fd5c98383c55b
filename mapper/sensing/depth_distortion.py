"""Depth distortion: a smooth error of a camera's inverse depth that is the same in all its images."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import DepthImage
from mapper.core.geometry import Array
from mapper.sensing.planes import squares_of

_COLUMNS = 80
"""Cells in a row of an image, more than twenty in the finest cosine's wavelength."""
_SAMPLES = 4
_MAX_DEPTH_RANGE = 0.15
"""A cell with a larger range of depth, relative to its least, lies on an edge and has no surface."""
_MIN_KNOWN = 0.3

_RANSAC_SAMPLES, _SCORED_CELLS = 128, 600
_SAFE_DETERMINANT = 1e-3
_ON_PLANE_PER_M = 0.012
"""Half a pixel of a Kinect's disparity: some three times its distortion, and many times a cell's noise."""
_MIN_PLANE_SHARE = 0.12
_MAX_PLANES = 3
_REFITS = 3

_ORDERS = (7, 9)
"""Half periods down and across the image of the finest cosines."""
_PRIOR_PER_M = 0.004
_SIGMA_PER_M, _ROBUST_PER_M = 0.011, 0.012
"""Of a cell's residual, which its neighbours share in part, and from which it counts less (Cauchy)."""

_REPETITIONS = 2
"""Cells that distortion takes off their plane are left out at first, which hides a fifth to a half of it, so
what is left is measured again with the last result removed."""

_MIN_FRAMES = 15
_MIN_VARIATION = 0.1
"""Relief repeats as well where the camera stands still."""
_MIN_EXPLAINED = 0.2
"""Share of squared residuals, cross-validated: 0.30 to 0.81 for simulated sensors whose disparity is off by
0.15 px (rms) or more, at most 0.06 for others, and 0.04 for a Kinect before a cluttered desk, whose map
became worse by its correction."""
_MIN_RMS_PER_M = 0.0015
"""Sensors without distortion give up to 0.0008, by surfaces that are not quite plane; others 0.0027 on."""

_Cells = NDArray[np.intp]
_NormalEquations = tuple[Array, Array]
"""(D, D) normal matrix and (D,) right side of the least squares for the D coefficients of the cosines."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthDistortion:
    """How wrong a camera's inverse depth is, at every pixel.

    The part that turns planes into other planes, which is affine in the ray (x, y, 1), is unknown, and taken
    to be 0.

    Attributes:
        error_per_m: (H, W) float32 measured less true 1 / z, in 1/m.
        rms_per_m: Its root mean square, in 1/m.
        median_depth_m: Of the images that it was measured in.
    """

    error_per_m: NDArray[np.float32]
    rms_per_m: float
    median_depth_m: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the error of a depth at the median depth."""
        return self.rms_per_m * self.median_depth_m**2

    @property
    def text(self) -> str:
        """Its size in words."""
        return f"{self.rms_m * 100:.1f} cm (rms) at {self.median_depth_m:.1f} m"

    def corrected(self, depth_m: DepthImage) -> DepthImage:
        """Return (H, W) depths without the distortion, metres; 0 stays 0, no measurement."""
        scale = 1.0 - depth_m * self.error_per_m
        corrected: DepthImage = np.divide(depth_m, scale, out=np.zeros_like(depth_m), where=scale > 0.0)
        return corrected


def measure_distortion(images_m: Iterable[DepthImage], rays: NDArray[np.floating]) -> DepthDistortion | None:
    """Measure a camera's depth distortion on the large planes that its images show.

    The inverse depth of a plane is affine in the ray (x, y, 1), so what is left of the planes' cells after an
    affine fit is distortion, noise or relief. Only the distortion is the same in images of different views:
    it is the least-squares sum of cosines over all of them. The error is one of disparity (Herrera, Kannala &
    Heikkilä 2012, §3.2); that it can be learnt without a calibration target follows Teichman, Miller & Thrun
    2013.

    Args:
        images_m: (H, W) depth of frames spread over a log, metres, in the order of time; 0 is no measurement.
        rays: (H, W, 2) x / z and y / z of every pixel.

    Returns:
        The distortion. None if it is small, if planes are seen in few frames, if what one half of the log
        shows does not hold for the other, or if all frames have the same view.
    """
    side = max(rays.shape[1] // _COLUMNS, 1)
    grid = _grid(rays, side)
    inverses, planes = _images_of_planes(images_m, grid, side)
    if len(planes) < _MIN_FRAMES or _variation(inverses) < _MIN_VARIATION:
        return None
    equations = [grid.normal_equations(*image) for image in zip(inverses, planes, strict=True)]
    coefficients = _coefficients(equations)
    error = grid.error(coefficients)
    if np.sqrt((error**2).mean()) < _MIN_RMS_PER_M:
        return None
    if not _explained_share(inverses, planes, equations, grid) >= _MIN_EXPLAINED:
        return None
    for _ in range(_REPETITIONS):
        left = np.where(inverses > 0.0, inverses - error, 0.0)
        planes = [_refitted(*image, grid.rays) for image in zip(left, planes, strict=True)]
        equations = [grid.normal_equations(*image) for image in zip(left, planes, strict=True)]
        coefficients = _coefficients(equations, coefficients)
        error = grid.error(coefficients)
    return DepthDistortion(
        _error_of_pixels(coefficients, rays).astype(np.float32),
        rms_per_m=float(np.sqrt((error**2).mean())),
        median_depth_m=float(1.0 / np.median(inverses[inverses > 0.0])),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """Cells of an image, N of them, and what an error of the inverse depth is a sum of.

    Attributes:
        rays: (N, 3) rays x, y, 1 of the cells' middles.
        cosines: (N, D) cosines there.
    """

    rays: Array
    cosines: Array

    def error(self, coefficients: Array) -> Array:
        """Return the (N,) error of the inverse depth with these (D,) coefficients, 1/m."""
        return _curved(self.cosines @ coefficients, self.rays)

    def normal_equations(self, inverse: Array, planes: Iterable[_Cells]) -> _NormalEquations:
        """Return the normal equations of an image's (N,) inverse depths on its planes."""
        normal, side = np.zeros((self.cosines.shape[1],) * 2), np.zeros(self.cosines.shape[1])
        for cells in planes:
            basis, _ = np.linalg.qr(self.rays[cells])
            residual = inverse[cells] - basis @ (basis.T @ inverse[cells])
            rows = self.cosines[cells] - basis @ (basis.T @ self.cosines[cells])
            weighted = rows.T / (_SIGMA_PER_M**2 * (1.0 + (residual / _ROBUST_PER_M) ** 2))
            normal, side = normal + weighted @ rows, side + weighted @ residual
        return normal, side


def _grid(rays: NDArray[np.floating], side: int) -> _Grid:
    """Return square cells of so many pixels a side."""
    directions = _homogeneous(_samples(rays, side).mean(axis=2)).reshape(-1, 3)
    down, across = _cosine_bases(rays.shape[:2], side)
    return _Grid(directions, (down[:, None, :, None] * across[None, :, None, :]).reshape(len(directions), -1))


def _error_of_pixels(coefficients: Array, rays: NDArray[np.floating]) -> Array:
    """Return the (H, W) error of the inverse depth of every pixel, 1/m."""
    down, across = _cosine_bases(rays.shape[:2], 1)
    everywhere = (down @ coefficients.reshape(down.shape[1], -1) @ across.T).ravel()
    return _curved(everywhere, _homogeneous(rays).reshape(-1, 3)).reshape(rays.shape[:2])


def _images_of_planes(
    images_m: Iterable[DepthImage], grid: _Grid, side: int
) -> tuple[Array, list[list[_Cells]]]:
    """Return the (F, N) inverse depths of the images that show large planes, 1/m, and each one's planes."""
    generator = np.random.default_rng(0)
    inverses: list[Array] = []
    planes: list[list[_Cells]] = []
    for depth_m in images_m:
        inverse = _cells(depth_m, side).ravel()
        if (inverse > 0.0).mean() >= _MIN_KNOWN and (found := _planes(inverse, grid.rays, generator)):
            inverses.append(inverse)
            planes.append(found)
    return np.array(inverses), planes


def _explained_share(
    inverses: Array, planes: Sequence[Sequence[_Cells]], equations: Sequence[_NormalEquations], grid: _Grid
) -> float:
    """Return which share of a plane's squared residuals the error found in the other half of a log explains.

    The median of all planes, and the least of four ways to halve the log: in time, by distance, and by
    inclination to either axis of the image. Relief, too, is found in both halves where their views are alike,
    but it moves in the image with the camera.
    """

    def explained(some: _Cells, others: _Cells) -> Iterator[float]:
        error = grid.error(_coefficients([equations[k] for k in others]))
        for inverse, cells in ((inverses[k], cells) for k in some for cells in planes[k]):
            before = _curved(inverse[cells], grid.rays[cells])
            after = _curved((inverse - error)[cells], grid.rays[cells])
            yield 1.0 - float((after**2).sum() / (before**2).sum())

    shares: list[float] = []
    for order in _orders(inverses, grid):
        one, other = np.array_split(order, 2)
        shares.append(float(np.median([*explained(one, other), *explained(other, one)])))
    return min(shares)


def _orders(inverses: Array, grid: _Grid) -> list[_Cells]:
    """Return (F,) images in the order of time, of their distance, and of their inclination to both axes."""
    views = [_fitted(grid.rays[image > 0.0], image[image > 0.0]) for image in inverses]
    right, down, ahead = np.transpose(views)
    keys = (np.arange(len(inverses)), ahead, right / ahead, down / ahead)
    return [np.argsort(key, kind="stable") for key in keys]


def _homogeneous(rays: NDArray[np.floating]) -> Array:
    """Return (…, 3) rays x, y, 1."""
    return np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1, dtype=np.float64)


def _samples(image: NDArray[np.floating], side: int) -> Array:
    """Return (R, C, S, …) pixels of square cells, as many as are read of each."""
    step = max(side // _SAMPLES, 1)
    some = squares_of(image, side)[:, :, ::step, ::step]
    return some.reshape(*some.shape[:2], -1, *image.shape[2:]).astype(np.float64)


def _cells(depth_m: DepthImage, side: int) -> Array:
    """Return the (R, C) mean 1 / z of the cells, 1/m; 0 of those that are on an edge or little measured."""
    samples_m = _samples(depth_m, side)
    measured = samples_m > 0.0
    inverse = np.divide(1.0, samples_m, out=np.zeros_like(samples_m), where=measured)
    count = measured.sum(axis=2)
    nearest, farthest = inverse.max(axis=2), np.where(measured, inverse, np.inf).min(axis=2)
    known = (2 * count > measured.shape[2]) & (nearest <= (1.0 + _MAX_DEPTH_RANGE) * farthest)
    return np.where(known, inverse.sum(axis=2) / np.maximum(count, 1), 0.0)


def _cosine_bases(shape: tuple[int, ...], side: int) -> tuple[Array, Array]:
    """Return (R, D) cosines down and (C, A) cosines across an image at the middles of its cells."""
    down, across = (
        np.cos(np.pi * np.outer((np.arange(length // side) + 0.5) * side / length, np.arange(order + 1)))
        for length, order in zip(shape, _ORDERS, strict=True)
    )
    return down, across


def _planes(inverse: Array, directions: Array, generator: np.random.Generator) -> list[_Cells]:
    """Return the cells on each of an image's large planes, the largest first (RANSAC)."""
    left, planes = np.flatnonzero(inverse > 0.0), list[_Cells]()
    least = max(_MIN_PLANE_SHARE * len(left), 4.0)
    while len(planes) < _MAX_PLANES and len(left) >= least:
        triples = left[generator.integers(0, len(left), (_RANSAC_SAMPLES, 3))]
        corners = directions[triples]
        triples, corners = (
            part[np.abs(np.linalg.det(corners)) > _SAFE_DETERMINANT] for part in (triples, corners)
        )
        if not len(triples):
            break
        candidates = np.linalg.solve(corners, inverse[triples][..., None])[..., 0]
        some = left[:: max(len(left) // _SCORED_CELLS, 1)]
        near = np.abs(directions[some] @ candidates.T - inverse[some, None]) < _ON_PLANE_PER_M
        cells = _on_plane_of(some[near[:, near.sum(axis=0).argmax()]], left, inverse, directions)
        if len(cells) < least:
            break
        planes.append(cells)
        left = np.setdiff1d(left, cells, assume_unique=True)
    return planes


def _refitted(inverse: Array, planes: Sequence[_Cells], directions: Array) -> list[_Cells]:
    """Return the cells on each of an image's planes, some of whose cells are known."""
    left, refitted = np.flatnonzero(inverse > 0.0), list[_Cells]()
    for plane in planes:
        refitted.append(_on_plane_of(plane, left, inverse, directions))
        left = np.setdiff1d(left, refitted[-1], assume_unique=True)
    return refitted


def _on_plane_of(some: _Cells, left: _Cells, inverse: Array, directions: Array) -> _Cells:
    """Return those of the cells that are left which lie on the plane of some of them."""
    for _ in range(_REFITS):
        plane = _fitted(directions[some], inverse[some])
        some = left[np.abs(directions[left] @ plane - inverse[left]) < _ON_PLANE_PER_M]
    return some


def _coefficients(equations: Sequence[_NormalEquations], removed: Array | None = None) -> Array:
    """Return the cosines' coefficients, 1/m, with a prior of 0, from what is left when some are removed."""
    normal = np.sum([normal for normal, _ in equations], axis=0)
    side = np.sum([side for _, side in equations], axis=0)
    if removed is not None:
        side = side + normal @ removed
    prior = np.eye(len(side)) / _PRIOR_PER_M**2
    return np.asarray(np.linalg.solve(normal + prior, side), dtype=np.float64)


def _curved(values: Array, directions: Array) -> Array:
    """Return (N,) values without the part that is affine in the (N, 3) rays."""
    return values - directions @ _fitted(directions, values)


def _fitted(rows: Array, values: Array) -> Array:
    """Return the least-squares solution of rows · x = values."""
    return np.asarray(np.linalg.lstsq(rows, values, rcond=None)[0], dtype=np.float64)


def _variation(inverse: Array) -> float:
    """Return by how much the inverse depth of a cell varies over (F, N) images: σ / mean, median."""
    known = inverse > 0.0
    count = known.sum(axis=0)
    often = count >= _MIN_FRAMES
    if not often.any():
        return 0.0
    mean = inverse.sum(axis=0)[often] / count[often]
    square = (inverse**2).sum(axis=0)[often] / count[often]
    return float(np.median(np.sqrt(np.maximum(square - mean**2, 0.0)) / mean))
