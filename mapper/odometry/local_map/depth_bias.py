"""Check of a depth camera's disparity: its error lengthens or shortens every path, most in far views."""

from dataclasses import replace

import numpy as np

from mapper.core.geometry import Array
from mapper.odometry.local_map.bundle import Bundle, WindowEstimates, estimated

_MIN_WINDOWS, _MIN_OBSERVERS = 4, 3
_STEPS, _MAX_STEP_PER_M = 4, 0.03
_MIN_ERROR, _MIN_SIGMAS = 0.02, 4.0
"""Smaller errors of the depth of most features, as a share, are usual."""


class DepthBiasCheck:
    """Estimate of the error of inverse depths that a log's images and depth fit, the same in all pixels.

    Depth cameras triangulate: an error of their disparity is one of the inverse depth, so the share by which
    depths are wrong grows with them (Khoshelham & Elberink 2012, eq. 5). Images tell by which share a surface
    comes nearer while the camera moves, and so whether its depths from far and from near agree.
    """

    def __init__(self) -> None:
        self._biases_per_m = WindowEstimates(least=_MIN_WINDOWS)
        self._depths_m: list[float] = []

    @property
    def is_complete(self) -> bool:
        """Whether enough windows were added."""
        return self._biases_per_m.are_complete

    def add(self, bundle: Bundle) -> None:
        """Add a window of keyframes."""
        seen = bundle.of_points_seen_by(_MIN_OBSERVERS)
        self._biases_per_m.add(*estimated(seen, _corrected, steps=_STEPS, max_step=_MAX_STEP_PER_M))
        if len(seen.edges):
            self._depths_m.append(float(np.median(seen.points_camera()[:, 2])))

    def estimate(self) -> tuple[float, float]:
        """Return what is to be added to every inverse depth, 1/m, and its standard deviation."""
        return self._biases_per_m.mean()

    def contradiction(self) -> str:
        """Return in words that depths are wrong, the more the farther; empty if they are not."""
        bias_per_m, sigma_per_m = self.estimate()
        if not self._depths_m or abs(bias_per_m) < _MIN_SIGMAS * sigma_per_m:
            return ""
        depth_m = float(np.median(self._depths_m))
        error = bias_per_m * depth_m
        if abs(error) < _MIN_ERROR:
            return ""
        return (
            f"depths of {depth_m:.1f} m are {100.0 * abs(error):.1f} ± {100.0 * sigma_per_m * depth_m:.1f} % "
            f"too {'large' if error > 0.0 else 'small'}, farther ones more: add {bias_per_m:.4f} to "
            "source.inverse_depth_offset_per_m; path and map are as wrong"
        )


def _corrected(bundle: Bundle, bias_per_m: float) -> tuple[Bundle, Array]:
    """Return the bundle with a number added to its inverse depths, and the slopes of its residuals."""
    bf = bundle.intrinsics[4]
    slopes = np.zeros_like(bundle.measured)
    slopes[~np.isnan(bundle.measured[:, 2]), 2] = bf
    return replace(bundle, measured=bundle.measured + np.array([0.0, 0.0, bf * bias_per_m])), slopes
