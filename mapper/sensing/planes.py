"""Planes fitted to patches of depth images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array

MAX_NOISE_RATIO = 0.05
"""A patch whose depths scatter by a larger share of their distance is not a plane."""

TILES_ACROSS = 16
"""Number of tiles in the width of an image."""
MIN_TILES, MIN_FRAMES = 30, 3
"""Number of tiles, and of frames that show them, from which the noise at a distance is known."""

_MIN_PLANE_RATIO = 0.98
_MAX_TILT_RAD = np.radians(60.0)
"""Up to here a Kinect's axial noise does not depend on the angle (Nguyen et al. 2012, §4)."""
_LEVEL_RATIO = 1.1
_ROUNDS = 4
_OUTLIER_SIGMAS = 4.0
LEAST_SIGMA_M = 1e-6
"""Noise of exact depth images, which is not 0 only by rounding."""
_SAFE_DETERMINANT = 1e-18


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """T planes, each through a patch of N pixels.

    On a plane the inverse depth is linear in the ray (x, y, 1) of a pixel: 1 / z = p·x + q·y + r.

    Attributes:
        coefficients: (T, 3) p, q, r in 1/m.
        depth_m: (T, N) depth of the plane at every pixel.
        used: (T, N) which pixels the plane rests on.
        sigma_m: (T,) standard deviation of their depths from the plane.
    """

    coefficients: Array
    depth_m: Array
    used: NDArray[np.bool_]
    sigma_m: Array

    @property
    def distance_m(self) -> Array:
        """(T,) depth at which the optical axis meets the plane."""
        return 1.0 / self.coefficients[:, 2]

    @property
    def tilt_rad(self) -> Array:
        """(T,) angle between the plane's normal and the optical axis."""
        p, q, r = self.coefficients.T
        tilt: Array = np.arctan2(np.hypot(p, q), np.abs(r))
        return tilt

    def explain(self, measured: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (T,) whether a plane of at most 60° tilt rests on 98 % of the (T, N) measured pixels."""
        are_used = self.used.sum(axis=1) >= _MIN_PLANE_RATIO * measured.sum(axis=1)
        explained: NDArray[np.bool_] = are_used & (self.tilt_rad <= _MAX_TILT_RAD)
        return explained


def squares_of(image: NDArray[np.floating], side: int) -> NDArray[np.floating]:
    """Return the (R, C, side, side, …) squares of an (H, W, …) image; what is left at its ends is dropped."""
    rows, columns = image.shape[0] // side, image.shape[1] // side
    whole = image[: rows * side, : columns * side]
    return whole.reshape(rows, side, columns, side, *image.shape[2:]).swapaxes(1, 2)


def cut_tiles(image: NDArray[np.floating], side: int) -> Array:
    """Return the (T, side², …) squares of an (H, W, …) image, row by row, as float64."""
    return squares_of(image, side).reshape(-1, side * side, *image.shape[2:]).astype(np.float64)


def distance_levels(distance_m: Array, frame_of: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the tiles at each distance, in steps of 10 %, where enough frames show enough of them.

    Args:
        distance_m: (T,) distances of tiles.
        frame_of: (T,) number of the frame of each.

    Returns:
        Indices of the tiles of each level, from near to far.
    """
    steps = np.floor(np.log(distance_m) / np.log(_LEVEL_RATIO))
    levels = [np.flatnonzero(steps == step) for step in np.unique(steps)]
    return [
        level for level in levels if len(level) >= MIN_TILES and len(np.unique(frame_of[level])) >= MIN_FRAMES
    ]


def fit_planes(depth_m: Array, rays: Array) -> Planes:
    """Fit a plane to every patch by least squares of the depths, without those more than 4 σ off.

    Args:
        depth_m: (T, N) depth along the optical axis, 0 or less where nothing was measured.
        rays: (T, N, 2) x / z and y / z of every pixel.
    """
    directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
    measured = depth_m > 0.0
    inverse_depth = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=measured)
    coefficients = _solved(directions, inverse_depth, measured)
    used = measured
    for _ in range(_ROUNDS):
        on_plane_m, sigma_m = _on_plane(coefficients, directions, depth_m, used)
        limit_m = _OUTLIER_SIGMAS * np.maximum(sigma_m, LEAST_SIGMA_M)
        used = measured & (np.abs(depth_m - on_plane_m) <= limit_m[:, None])
        # Gauss–Newton: z changes by −z² · ray with the coefficients.
        rows = -directions * on_plane_m[..., None] ** 2
        coefficients = coefficients + _solved(rows, depth_m - on_plane_m, used)
    on_plane_m, sigma_m = _on_plane(coefficients, directions, depth_m, used)
    return Planes(coefficients, on_plane_m, used, sigma_m)


def _on_plane(
    coefficients: Array, directions: Array, depth_m: Array, used: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return (T, N) depth on the planes, and (T,) how far the pixels in use scatter about it."""
    with np.errstate(divide="ignore"):
        on_plane_m = 1.0 / (directions @ coefficients[..., None])[..., 0]
    squares = np.where(used, (depth_m - on_plane_m) ** 2, 0.0).sum(axis=1)
    # A plane takes three degrees of freedom.
    return on_plane_m, np.sqrt(squares / np.maximum(used.sum(axis=1) - 3, 1))


def _solved(rows: Array, values: Array, used: NDArray[np.bool_]) -> Array:
    """Return (T, 3) least-squares solutions of the rows (T, N, 3) in use; 0 where they leave it open."""
    kept = np.where(used[..., None], rows, 0.0)
    columns = kept.swapaxes(1, 2)
    normal, side = columns @ kept, (columns @ values[..., None])[..., 0]
    open_ = np.linalg.det(normal) < _SAFE_DETERMINANT * np.trace(normal, axis1=1, axis2=2) ** 3
    normal[open_] = np.eye(3)
    side[open_] = 0.0
    return np.linalg.solve(normal, side[..., None])[..., 0]
