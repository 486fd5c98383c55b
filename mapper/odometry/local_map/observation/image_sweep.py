"""Motion of a camera while the rows of one image were read, by that image alone (Hedborg et al. 2012, §3)."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from mapper.core.geometry import Array
from mapper.core.linear import solve_positive, twist_exp
from mapper.registration.reprojection import HUBER_2DOF, pose_jacobian, projection_jacobian, residual

_ITERATIONS = 3
_WIDE = np.repeat([0.1, 0.05], 3)
"""Standard deviation (rad, m) of the motion about 0: that of a fast hand, so that the image determines it."""
_KEPT = 0.95
"""Of the mean square of what is left of the motion, from image to image: some 20 images count."""
_PRIOR_S = 0.01
"""Standard deviation of the readout time before anything is measured."""
_MIN_SIGMAS = 5.0
"""Motion within images that follows the velocity less surely is not that of a rolling shutter."""


@dataclass(frozen=True, slots=True)
class _Sweep:
    """Motion within an image (6,), its information (6, 6), and the velocity (6,) before or around it."""

    motion: Array
    information: Array
    velocity: Array


class SweepErrors:
    """Errors of poses by motion within images that was not taken out of them.

    Images of a camera that is shaken faster than frames follow show more of it than their velocities.
    Its mean square is measured against the motion that was taken out. It counts once the motion within images
    follows the velocity, as with a rolling shutter: their changes from image to image must agree, as errors
    of depth or lens follow the distance from a keyframe, and so the velocity itself. Errors of landmarks that
    both images share cancel.
    """

    def __init__(self) -> None:
        """Start before the first image."""
        self._square, self._counted = np.zeros((6, 6)), 0.0
        self._information, self._weighted = _PRIOR_S**-2, 0.0
        self.restart()

    def restart(self) -> None:
        """Reset the last images, but not their statistics, after a gap."""
        self._last: _Sweep | None = None
        self._before: _Sweep | None = None
        self._pose_per_motion: Array | None = None

    @property
    def is_rolling(self) -> bool:
        """Whether the motion within images follows the velocity."""
        return abs(self._weighted) > _MIN_SIGMAS * float(np.sqrt(self._information))

    @property
    def pose_covariance(self) -> Array:
        """(6, 6) of the last image's pose, camera tangent; 0 for a global shutter or an unknown motion."""
        if self._pose_per_motion is None or not self.is_rolling:
            return np.zeros((6, 6))
        mean_square = self._square / self._counted
        return self._pose_per_motion @ mean_square @ self._pose_per_motion.T

    def follow(self, velocity: Array | None) -> None:
        """Take the velocity (6,) since the last image, before the next ``add``; None if it is unknown."""
        last, before = self._last, self._before
        self.restart()
        if last is None or velocity is None:
            return
        self._before = _Sweep(last.motion, last.information, 0.5 * (last.velocity + velocity))
        if before is not None:
            # A quarter of the sum is the information of a difference where both have the same.
            information = 0.25 * (last.information + before.information)
            change = self._before.velocity - before.velocity
            self._information += float(change @ information @ change)
            self._weighted += float(change @ information @ (last.motion - before.motion))

    def add(self, found: tuple[Array, Array, Array], velocity: Array, taken_out: Array) -> None:
        """Add an image.

        Args:
            found: Its motion, as ``image_sweep`` returns it.
            velocity: (6,) of the camera since the image before, per second.
            taken_out: (6,) motion by which its features were corrected.
        """
        motion, information, self._pose_per_motion = found
        self._last = _Sweep(motion, information, velocity)
        left = motion - taken_out
        self._square = _KEPT * self._square + (1.0 - _KEPT) * np.outer(left, left)
        self._counted = _KEPT * self._counted + 1.0 - _KEPT


@njit(cache=True, nogil=True)
def swept_rows(T, point, measured, sweep, intrinsics, height_px, scratch, r, J_both):  # type: ignore[no-untyped-def]
    """Fill in a point's residuals (3,) and their Jacobian (3, 12) by pose and motion over all rows.

    Args:
        T: (4, 4) T_camera_world when the middle row is read.
        point: (3,) metres, world.
        measured: (3,) u, v as they were read, and bf/z; NaN without depth.
        sweep: (6,) the motion.
        intrinsics: (5,) fx, fy, cx, cy, bf.
        height_px: Number of rows.
        scratch: (3, 3) and (3, 6) to work in.
        r: The residuals.
        J_both: The Jacobian.
    """
    J, J_pose = scratch
    phase = (measured[1] + 0.5) / height_px - 0.5
    x, y, z = residual(T, point, measured, intrinsics, r)
    projection_jacobian(x, y, z, intrinsics, not np.isnan(measured[2]), J)
    pose_jacobian(x, y, z, J, J_pose)
    for i in range(3):
        for a in range(6):
            J_both[i, a] = J_pose[i, a]
            # A point moves against the camera; the disparity's change is taken out of it already.
            J_both[i, 6 + a] = -phase * J_pose[i, a] if i < 2 else 0.0
            r[i] -= J_both[i, 6 + a] * sweep[a]


@njit(cache=True, nogil=True)
def image_sweep(T_camera_world, points, measured, weights, intrinsics, height_px):  # type: ignore[no-untyped-def]
    """Return the camera's (6,) motion over all rows, its information and the pose's change by it (6, 6).

    Gauss-Newton on the pose and the motion, with Huber weights. The information is that of the image without
    the prior, the pose eliminated, and scaled by the residuals' variance. The change is that of the pose,
    T_camera_world, if so much more motion is taken for none.

    Args:
        T_camera_world: (4, 4) pose to begin at.
        points: (M, 3) metres, world.
        measured: (M, 3) u, v as they were read, and bf/z; NaN in the third column without depth.
        weights: (M, 3) inverse variances, px⁻².
        intrinsics: (5,) fx, fy, cx, cy, bf.
        height_px: Number of rows.
    """
    T, sweep = T_camera_world.copy(), np.zeros(6)
    for _ in range(_ITERATIONS):
        H, g, precision = _normal_equations(T, sweep, points, measured, weights, intrinsics, height_px)
        with_prior = H.copy()
        for a in range(6):
            with_prior[6 + a, 6 + a] += _WIDE[a] ** -2
            g[6 + a] -= _WIDE[a] ** -2 * sweep[a]
        for a in range(12):
            with_prior[a, a] += 1e-9
        step = solve_positive(with_prior, g)
        T = twist_exp(step[:6], T)
        sweep += step[6:]
    information, change = _marginal(H)
    return sweep, information * precision, change


@njit(cache=True, nogil=True)
def _normal_equations(T, sweep, points, measured, weights, intrinsics, height_px):  # type: ignore[no-untyped-def]
    """Return the (12, 12) and (12,) equations of pose and motion, and the inverse variance of residuals."""
    r, J_both, scratch = np.empty(3), np.zeros((3, 12)), (np.empty((3, 3)), np.empty((3, 6)))
    H, g = np.zeros((12, 12)), np.zeros(12)
    square_sum = count = 0.0
    for n in range(len(points)):
        swept_rows(T, points[n], measured[n], sweep, intrinsics, height_px, scratch, r, J_both)
        for i in range(2 if np.isnan(measured[n, 2]) else 3):
            row, error = J_both[i], r[i]
            w = weights[n, i]
            sigmas = np.sqrt(w) * abs(error)
            if sigmas > HUBER_2DOF:
                w *= HUBER_2DOF / sigmas
            square_sum += w * error * error
            count += 1.0
            for a in range(12):
                g[a] += w * row[a] * error
                for b in range(12):
                    H[a, b] += w * row[a] * row[b]
    return H, g, max(count - 12.0, 1.0) / max(square_sum, 1e-9)


@njit(cache=True, nogil=True)
def _marginal(H):  # type: ignore[no-untyped-def]
    """Return the motion's (6, 6) information with the pose eliminated, and the pose's change by it (6, 6)."""
    information, change = H[6:, 6:].copy(), np.empty((6, 6))
    H_pose = H[:6, :6] + 1e-9 * np.eye(6)
    for b in range(6):
        change[:, b] = solve_positive(H_pose, H[:6, 6 + b].copy())
        for a in range(6):
            for c in range(6):
                information[a, b] -= H[6 + a, c] * change[c, b]
    return information, change
