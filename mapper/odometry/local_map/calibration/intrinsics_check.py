"""Check of a camera's intrinsics against its images: wrong ones stretch and shear a map without a loss."""

from dataclasses import replace

import numpy as np

from mapper.core.geometry import Array
from mapper.odometry.local_map.bundle.bundle import Bundle, NestedEstimates, are_significant

_MIN_WINDOWS, _MIN_OBSERVERS = 3, 3
_PRIOR_SIGMAS = np.array([1.0, 1.0, 1.0, 1.0, 0.3])
_SIGMAS, _MAX_STEPS = (8.0, 4.0, 2.0, *[1.0] * 10), np.full(5, 0.1)
"""Enough for the intrinsics of images of twice or half the size."""
_UNDISTORT_STEPS = 10
_LEAST, _MIN_SIGMAS = np.array([0.03, 0.03, 0.035, 0.035, 0.03]), 5.0
"""Least errors that are told. Simulated logs with right intrinsics give a focal length within 0.002 of it,
but a real depth image has errors, too: fr1_xyz gives 0.020 ± 0.006, parts of it 0.025 ± 0.007, and a k1 of
0.015 ± 0.003."""
_LEAST_K1 = np.array([0.02])
"""Least error of k1 with which it is estimated."""
_NAMES = ("fx", "fy", "cx", "cy")


class IntrinsicsCheck:
    """Estimate of the intrinsics that a log's images and depth fit, relative to those that are given.

    Rotations shift pixels by the focal length, and translations by its share of the inverse depth, which the
    depth images measure. A wrong principal point shears the reconstruction, so that views of the same things
    from other directions do not fit each other. Distortion of the lens stretches a view as the focal length
    does, but not evenly. All are estimated together: one that is held at a wrong value falsifies the others.
    """

    def __init__(self) -> None:
        self._errors = NestedEstimates(_PRIOR_SIGMAS, _MAX_STEPS, first=4, sigmas=_SIGMAS, least=_MIN_WINDOWS)

    @property
    def is_complete(self) -> bool:
        """Whether enough windows were added."""
        return self._errors.are_complete

    def add(self, bundle: Bundle) -> None:
        """Add a window of keyframes."""
        seen = bundle.of_points_seen_by(_MIN_OBSERVERS)
        self._errors.add(seen, _Intrinsics(seen))

    def estimate(self) -> tuple[Array, Array] | None:
        """Return the errors of the given intrinsics and their standard deviations.

        None where windows are too few. Both are (5,): the logarithms of the factors that fx and fy lack, what
        cx and cy lack as a share of the focal length, and what the distortion's k1 lacks. Where that may be
        nothing it is taken as 0: it is hardly told from a focal length.
        """
        return self._errors.mean(least=_LEAST_K1, min_sigmas=_MIN_SIGMAS)

    def contradictions(self, given_px: Array) -> list[str]:
        """Return in words that the images contradict the intrinsics.

        Args:
            given_px: fx, fy, cx and cy.
        """
        found = self.estimate()
        if found is None:
            return []
        errors, sigmas = found
        is_off = are_significant(errors, sigmas, least=_LEAST, min_sigmas=_MIN_SIGMAS)
        if not is_off.any():
            return []
        fitting_px = _moved(given_px[:4], errors)
        sigmas_px = sigmas[:4] * np.tile(fitting_px[:2], 2)
        wrong = [
            f"{name} = {fitting:.1f} ± {sigma:.1f} px, not {given:.1f} px"
            for name, fitting, sigma, given in zip(
                np.array(_NAMES)[is_off[:4]],
                fitting_px[is_off[:4]],
                sigmas_px[is_off[:4]],
                given_px[:4][is_off[:4]],
                strict=True,
            )
        ]
        lens = "with source.camera.distortion, if the lens has any"
        if is_off[4]:
            k1 = f"{errors[4]:+.3f}"
            wrong.append(f"a lens whose radial distortion k1 is {k1} ± {sigmas[4]:.3f} from the given one")
            lens = f"with source.camera.distortion, to whose k1, the first number, {k1} is added"
        settings = [
            f"--set source.camera.{name}_px={value:.1f}"
            for name, value in zip(_NAMES, fitting_px, strict=True)
        ]
        return [
            f"the images fit {', '.join(wrong)}; distances across the view are wrong by as much: check the "
            f"log's calibration, or {' '.join(settings)} ({lens})"
        ]


class _Intrinsics:
    """Intrinsics of a bundle that are off by given errors, as ``IntrinsicsCheck.estimate`` returns them."""

    def __init__(self, bundle: Bundle) -> None:
        self._given, self._pixels = bundle.intrinsics, bundle.measured[:, :2]

    def __call__(self, bundle: Bundle, errors: Array) -> tuple[Bundle, Array]:
        """Return the bundle with the other intrinsics, and the (5, E, 2) slopes of u and v."""
        x, y, z = bundle.points_camera().T
        fx_px, fy_px, cx_px, cy_px = _moved(self._given[:4], errors)
        slopes = np.zeros((5, len(z), 2))
        slopes[0, :, 0], slopes[1, :, 1] = -fx_px * x / z, -fy_px * y / z
        slopes[2, :, 0], slopes[3, :, 1] = -self._given[:2, np.newaxis]
        given_focal_px, given_centre_px = self._given[:2], self._given[2:4]
        distorted = (self._pixels - given_centre_px) / given_focal_px
        # The slope is that at the predicted pixel: noise would correlate it with the residual, which biases.
        ray = (
            np.column_stack([fx_px * x / z + cx_px, fy_px * y / z + cy_px]) - given_centre_px
        ) / given_focal_px
        square = (ray**2).sum(axis=1, keepdims=True)
        slopes[4] = -given_focal_px * ray * square / np.maximum(1.0 + 3.0 * errors[4] * square, 0.5)
        pixels = given_centre_px + given_focal_px * _undistorted(distorted, float(errors[4]))
        measured = np.column_stack([pixels, bundle.measured[:, 2]])
        intrinsics = np.array([fx_px, fy_px, cx_px, cy_px, self._given[4]])
        return replace(bundle, measured=measured, intrinsics=intrinsics), slopes


def _undistorted(distorted: Array, k1: float) -> Array:
    """Return (E, 2) rays, x/z and y/z, without a distortion."""
    rays = distorted
    for _ in range(_UNDISTORT_STEPS):
        rays = distorted / np.maximum(1.0 + k1 * (rays**2).sum(axis=1, keepdims=True), 0.5)
    return rays


def _moved(intrinsics_px: Array, errors: Array) -> Array:
    """Return fx, fy, cx and cy without their errors."""
    focal_px, centre_px = intrinsics_px[:2], intrinsics_px[2:]
    return np.concatenate([focal_px * np.exp(errors[:2]), centre_px + focal_px * errors[2:4]])
