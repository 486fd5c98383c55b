"""Check of a camera's intrinsics against its images: wrong ones stretch and shear a map without a loss."""

from dataclasses import replace

import numpy as np

from mapper.core.geometry import Array
from mapper.odometry.local_map.bundle import Bundle, WindowEstimates, estimated

_MIN_WINDOWS, _MIN_OBSERVERS = 3, 3
_STEPS, _MAX_STEP = 10, 0.1
"""Enough for the intrinsics of images of twice or half the size."""
_MIN_FOCAL_ERROR, _MIN_CENTRE_ERROR, _MIN_SIGMAS = 0.04, 0.035, 4.0
"""Smaller errors, relative to the focal length, are usual: lens distortion that is not modelled, and makers'
values; parts of a real log with right intrinsics give 0.025 ± 0.007. Of 0.05 a path is 1 % wrong."""


_NAMES = ("fx", "fy", "cx", "cy")


class IntrinsicsCheck:
    """Estimate of the intrinsics that a log's images and depth fit, relative to those that are given.

    Rotations shift pixels by the focal length, and translations by its share of the inverse depth, which the
    depth images measure. A wrong principal point shears the reconstruction, so that views of
    the same things from other directions do not fit each other. All four are estimated together: one that is
    held at a wrong value falsifies the others.
    """

    def __init__(self) -> None:
        self._errors = WindowEstimates(least=_MIN_WINDOWS)

    @property
    def is_complete(self) -> bool:
        """Whether enough windows were added."""
        return self._errors.are_complete

    def add(self, bundle: Bundle) -> None:
        """Add a window of keyframes."""
        seen = bundle.of_points_seen_by(_MIN_OBSERVERS)
        self._errors.add(*estimated(seen, _Intrinsics(seen), parameters=4, steps=_STEPS, max_step=_MAX_STEP))

    def estimate(self) -> tuple[Array, Array] | None:
        """Return the errors of the given intrinsics and their standard deviations.

        None where windows are too few. Both are (4,): the logarithms of the factors that fx and fy lack, and
        what cx and cy lack as a share of the focal length.
        """
        return self._errors.mean()

    def contradiction(self, given_px: Array) -> str:
        """Return in words that the images contradict the intrinsics; empty if they do not.

        Args:
            given_px: fx, fy, cx and cy.
        """
        found = self.estimate()
        if found is None:
            return ""
        errors, sigmas = found
        least = np.array([_MIN_FOCAL_ERROR, _MIN_FOCAL_ERROR, _MIN_CENTRE_ERROR, _MIN_CENTRE_ERROR])
        is_off = np.abs(errors) >= np.maximum(least, _MIN_SIGMAS * sigmas)
        if not is_off.any():
            return ""
        fitting_px = _moved(given_px[:4], errors)
        sigmas_px = sigmas * np.tile(fitting_px[:2], 2)
        wrong = [
            f"{name} = {fitting:.1f} ± {sigma:.1f} px, not {given:.1f} px"
            for name, fitting, sigma, given in zip(
                np.array(_NAMES)[is_off],
                fitting_px[is_off],
                sigmas_px[is_off],
                given_px[:4][is_off],
                strict=True,
            )
        ]
        settings = [
            f"--set source.camera.{name}_px={value:.1f}"
            for name, value in zip(_NAMES, fitting_px, strict=True)
        ]
        return (
            f"the images fit {', '.join(wrong)}; distances across the view are wrong by as much: check the "
            f"log's calibration, or {' '.join(settings)} (with source.camera.distortion, if the lens has any)"
        )


class _Intrinsics:
    """Intrinsics of a bundle that are off by given errors, as ``IntrinsicsCheck.estimate`` returns them."""

    def __init__(self, bundle: Bundle) -> None:
        self._given = bundle.intrinsics

    def __call__(self, bundle: Bundle, errors: Array) -> tuple[Bundle, Array]:
        """Return the bundle with the other intrinsics, and the (4, E, 2) slopes of u and v."""
        x, y, z = bundle.points_camera().T
        fx_px, fy_px, cx_px, cy_px = _moved(self._given[:4], errors)
        slopes = np.zeros((4, len(z), 2))
        slopes[0, :, 0], slopes[1, :, 1] = -fx_px * x / z, -fy_px * y / z
        slopes[2, :, 0], slopes[3, :, 1] = -self._given[:2, np.newaxis]
        return replace(bundle, intrinsics=np.array([fx_px, fy_px, cx_px, cy_px, self._given[4]])), slopes


def _moved(intrinsics_px: Array, errors: Array) -> Array:
    """Return fx, fy, cx and cy without their errors."""
    focal_px, centre_px = intrinsics_px[:2], intrinsics_px[2:]
    return np.concatenate([focal_px * np.exp(errors[:2]), centre_px + focal_px * errors[2:]])
