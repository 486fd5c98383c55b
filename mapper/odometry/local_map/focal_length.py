"""Check of a camera's focal length against its images: wrong intrinsics stretch every map without a loss."""

from dataclasses import replace

import numpy as np

from mapper.core.geometry import Array
from mapper.odometry.local_map.bundle import Bundle, WindowEstimates, estimated

_MIN_WINDOWS, _MIN_OBSERVERS = 4, 3
_STEPS, _MAX_STEP = 2, 0.1
_MIN_ERROR, _MIN_SIGMAS = 0.03, 4.0
"""Smaller relative errors are usual: lens distortion that is not modelled, and makers' nominal values."""


class FocalLengthCheck:
    """Estimate of the focal length that a log's images and depth fit, relative to the one that is given.

    Rotations shift pixels by the focal length, and translations by its share of the inverse depth, which the
    depth images measure.
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
        self._errors.add(*estimated(seen, _stretched, steps=_STEPS, max_step=_MAX_STEP))

    def estimate(self) -> tuple[float, float]:
        """Return the relative error of the given focal length and its standard deviation, by all windows."""
        return self._errors.mean()

    def contradiction(self, fx_px: float) -> str:
        """Return in words that the images contradict the focal length; empty if they do not."""
        error, sigma = self.estimate()
        if abs(error) < max(_MIN_ERROR, _MIN_SIGMAS * sigma):
            return ""
        return (
            f"the images fit a focal length of {fx_px * (1.0 + error):.0f} px, not {fx_px:.0f} px "
            f"({100.0 * error:+.1f} ± {100.0 * sigma:.1f} %): check source.camera.fx_px and fy_px, or the "
            "log's calibration; distances across the view are wrong by as much"
        )


def _stretched(bundle: Bundle, error: float) -> tuple[Bundle, Array]:
    """Return the bundle with other focal lengths, and the slopes of u and v."""
    x, y, z = bundle.points_camera().T
    fx_px, fy_px = bundle.intrinsics[:2]
    scale = 1.0 + error
    slopes = -np.column_stack([fx_px * x / z, fy_px * y / z])
    return replace(bundle, intrinsics=bundle.intrinsics * [scale, scale, 1.0, 1.0, 1.0]), slopes
