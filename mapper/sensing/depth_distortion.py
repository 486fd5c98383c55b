"""Depth distortion: a smooth error of a camera's inverse depth that is the same in all its images."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import DepthImage
from mapper.core.geometry import Array

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

_ORDERS = (5, 7)
"""Half periods down and across the image of the finest cosines."""
_PRIOR_PER_M = 0.004
_SIGMA_PER_M, _ROBUST_PER_M = 0.011, 0.012
"""Of a cell's residual, which its neighbours share in part, and from which it counts less (Cauchy)."""

_MIN_FRAMES = 15
_MIN_VARIATION = 0.1
"""Relief repeats as well where the camera stands still."""
_MIN_CORRELATION = 0.8
"""Of the halves of a log: above 0.85 for sensors with distortion, mostly below 0.7 for others."""
_MIN_RMS_PER_M = 0.0015
"""Sensors without distortion give up to 0.0008, by surfaces that are not quite plane; others 0.0027 on."""

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
        The distortion. None if it is small, if planes are seen in few frames, if the halves of the log do not
        agree on it, or if all frames have the same view.
    """
    side = max(rays.shape[1] // _COLUMNS, 1)
    directions = _homogeneous(_samples(rays, side).mean(axis=2))
    down, across = _cosine_bases(rays.shape[:2], side)
    cosines = (down[:, None, :, None] * across[None, :, None, :]).reshape(*directions.shape[:2], -1)
    generator = np.random.default_rng(0)
    seen: list[Array] = []
    equations: list[_NormalEquations] = []
    for depth_m in images_m:
        inverse = _cells(depth_m, side)
        known = inverse > 0.0
        if known.mean() < _MIN_KNOWN:
            continue
        found = _normal_equations(inverse[known], directions[known], cosines[known], generator)
        if found is not None:
            seen.append(inverse)
            equations.append(found)
    if len(equations) < _MIN_FRAMES:
        return None
    inverses = np.array(seen)
    if _variation(inverses) < _MIN_VARIATION:
        return None
    half = len(equations) // 2
    parts = [_coefficients(part) for part in (equations, equations[:half], equations[half:])]
    planes = [_fitted(directions.reshape(-1, 3), (cosines @ part).ravel()) for part in parts]
    errors = [
        (cosines @ part - directions @ plane).ravel() for part, plane in zip(parts, planes, strict=True)
    ]
    rms_per_m = float(np.sqrt((errors[0] ** 2).mean()))
    if rms_per_m < _MIN_RMS_PER_M or not np.corrcoef(errors[1], errors[2])[0, 1] >= _MIN_CORRELATION:
        return None
    down, across = _cosine_bases(rays.shape[:2], 1)
    error_per_m = down @ parts[0].reshape(down.shape[1], -1) @ across.T - _homogeneous(rays) @ planes[0]
    median_depth_m = float(1.0 / np.median(inverses[inverses > 0.0]))
    return DepthDistortion(error_per_m.astype(np.float32), rms_per_m, median_depth_m)


def _homogeneous(rays: NDArray[np.floating]) -> Array:
    """Return (…, 3) rays x, y, 1."""
    return np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1, dtype=np.float64)


def _samples(image: NDArray[np.floating], side: int) -> Array:
    """Return (R, C, S, …) pixels of square cells, as many as are read of each."""
    rows, columns, step = image.shape[0] // side, image.shape[1] // side, max(side // _SAMPLES, 1)
    rest = image.shape[2:]
    whole = image[: rows * side, : columns * side].reshape(rows, side, columns, side, *rest)
    some = whole[:, ::step, :, ::step].swapaxes(1, 2)
    return some.reshape(rows, columns, -1, *rest).astype(np.float64)


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


def _normal_equations(
    inverse: Array, directions: Array, cosines: Array, generator: np.random.Generator
) -> _NormalEquations | None:
    """Return the normal equations of the planes of (N,) cells of one image; None if there are no planes."""
    normal, side, count = np.zeros((cosines.shape[1],) * 2), np.zeros(cosines.shape[1]), 0
    for cells in _planes(inverse, directions, generator):
        basis, _ = np.linalg.qr(directions[cells])
        residual = inverse[cells] - basis @ (basis.T @ inverse[cells])
        rows = cosines[cells] - basis @ (basis.T @ cosines[cells])
        weighted = rows.T / (_SIGMA_PER_M**2 * (1.0 + (residual / _ROBUST_PER_M) ** 2))
        normal, side, count = normal + weighted @ rows, side + weighted @ residual, count + 1
    return (normal, side) if count else None


def _planes(inverse: Array, directions: Array, generator: np.random.Generator) -> Iterator[NDArray[np.intp]]:
    """Yield the cells on each of an image's large planes, the largest first (RANSAC)."""
    left, least = np.arange(len(inverse)), max(_MIN_PLANE_SHARE * len(inverse), 4.0)
    for _ in range(_MAX_PLANES):
        if len(left) < least:
            return
        triples = left[generator.integers(0, len(left), (_RANSAC_SAMPLES, 3))]
        corners = directions[triples]
        triples, corners = (
            part[np.abs(np.linalg.det(corners)) > _SAFE_DETERMINANT] for part in (triples, corners)
        )
        if not len(triples):
            return
        planes = np.linalg.solve(corners, inverse[triples][..., None])[..., 0]
        some = left[:: max(len(left) // _SCORED_CELLS, 1)]
        near = np.abs(directions[some] @ planes.T - inverse[some, None]) < _ON_PLANE_PER_M
        cells = some[near[:, near.sum(axis=0).argmax()]]
        for _ in range(_REFITS):
            plane = _fitted(directions[cells], inverse[cells])
            cells = left[np.abs(directions[left] @ plane - inverse[left]) < _ON_PLANE_PER_M]
        if len(cells) < least:
            return
        yield cells
        left = np.setdiff1d(left, cells, assume_unique=True)


def _coefficients(equations: Sequence[_NormalEquations]) -> Array:
    """Return the (D,) coefficients of the cosines, 1/m, with a prior of 0."""
    normal = sum((normal for normal, _ in equations), np.eye(len(equations[0][1])) / _PRIOR_PER_M**2)
    sides = np.sum([side for _, side in equations], axis=0)
    return np.asarray(np.linalg.solve(normal, sides), dtype=np.float64)


def _fitted(rows: Array, values: Array) -> Array:
    """Return the least-squares solution of rows · x = values."""
    return np.asarray(np.linalg.lstsq(rows, values, rcond=None)[0], dtype=np.float64)


def _variation(inverse: Array) -> float:
    """Return by how much the inverse depth of a cell varies over (F, R, C) images: σ / mean, median."""
    known = inverse > 0.0
    count = known.sum(axis=0)
    often = count >= _MIN_FRAMES
    if not often.any():
        return 0.0
    mean = inverse.sum(axis=0)[often] / count[often]
    square = (inverse**2).sum(axis=0)[often] / count[often]
    return float(np.median(np.sqrt(np.maximum(square - mean**2, 0.0)) / mean))
