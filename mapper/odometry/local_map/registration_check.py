"""Check of whether depth images are registered to colour images, so that a pixel is one ray in both."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mapper.core.geometry import Array
from mapper.odometry.local_map.bundle import Bundle, WindowEstimates, estimated
from mapper.odometry.local_map.depth_surfaces import surface_of
from mapper.odometry.local_map.image_observation import ImageObservation

_MIN_WINDOWS, _MIN_OBSERVERS = 3, 3
_STEPS, _MAX_STEP = 8, 0.1
"""Enough for depth images of 1.6 times the colour camera's angle of view."""
_MIN_MAGNIFICATION, _MIN_SIGMAS = 0.05, 4.0
"""Logarithm: the two cameras of a sensor differ by 9 % (Kinect 360) to 40 % (RealSense)."""


class RegistrationCheck:
    """Estimate of where depth images show what colour images show, relative to the same pixel.

    A camera of its own with another focal length takes the depth of a point from beside it, so that points
    that several keyframes see are nearer here and farther there. By how much depth images are magnified, and
    shifted, are unknowns of a bundle adjustment that reads depth at the pixels so moved.
    """

    def __init__(self) -> None:
        self._found = WindowEstimates(least=_MIN_WINDOWS)

    @property
    def is_complete(self) -> bool:
        """Whether enough windows were added."""
        return self._found.are_complete

    def add(self, bundle: Bundle, observed: Iterable[ImageObservation]) -> None:
        """Add a window of keyframes, with what was observed in each of them."""
        bundle = bundle.of_points_seen_by(_MIN_OBSERVERS)
        depth = DepthElsewhere(bundle, observed)
        self._found.add(*estimated(bundle, depth.read, parameters=3, steps=_STEPS, max_step=_MAX_STEP))

    def estimate(self) -> tuple[Array, Array] | None:
        """Return what depth images are off by and its standard deviations; None where windows are too few.

        Both are (3,): the logarithm of their focal length over that of the colour images, and by how far they
        are shifted along rows and columns, as a share of the colour images' focal length.
        """
        return self._found.mean()

    def contradiction(self) -> str:
        """Return in words that depth images are not registered; empty if they may be."""
        found = self.estimate()
        if found is None:
            return ""
        magnification, sigma = (float(values[0]) for values in found)
        if abs(magnification) < max(_MIN_MAGNIFICATION, _MIN_SIGMAS * sigma):
            return ""
        factor = float(np.exp(magnification))
        return (
            f"depth images are not registered to the colour images: theirs is {factor:.2f} ± "
            f"{factor * sigma:.2f} times the focal length, so that depth belongs to other pixels: record "
            "registered (aligned) depth, or register the images by the sensor's own software"
        )


class DepthElsewhere:
    """Depth of a bundle's observations where depth images are magnified and shifted."""

    def __init__(self, bundle: Bundle, observed: Iterable[ImageObservation]) -> None:
        """Fit planes to the depth images.

        Args:
            bundle: Keyframes with their observations.
            observed: What was observed in each of them.
        """
        self._views = []
        for k, observation in enumerate(observed):
            if observation.depth_cells is not None:
                edges = np.flatnonzero(bundle.edges[:, 0] == k)
                pixels = observation.pixels[bundle.features[edges]]
                self._views.append((edges, pixels, surface_of(observation.depth_cells)))

    def read(self, bundle: Bundle, off: Array) -> tuple[Bundle, Array]:
        """Return the bundle with the disparities that depth images have elsewhere.

        Points that are on no plane there have no depth.

        Args:
            bundle: The one of the beginning, perhaps adjusted.
            off: (3,) as ``RegistrationCheck.estimate`` returns it.

        Returns:
            The bundle, and the (3, E, 3) change of its residuals, px.
        """
        focal_px, centre_px, bf = bundle.intrinsics[:2], bundle.intrinsics[2:4], bundle.intrinsics[4]
        disparity_px, slopes = np.full(len(bundle.edges), np.nan), np.zeros((3, len(bundle.edges), 3))
        for edges, pixels, surface in self._views:
            from_centre = (pixels - centre_px) / focal_px * np.exp(off[0])
            ray = from_centre + off[1:]
            planes = surface.planes_at(centre_px + focal_px * ray)
            n = planes[:, :3] / np.where(planes[:, 3:] > 0.0, planes[:, 3:], np.nan)
            disparity_px[edges] = bf * ((n[:, :2] * ray).sum(axis=1) + n[:, 2])
            slopes[0, edges, 2] = bf * (n[:, :2] * from_centre).sum(axis=1)
            slopes[1:, edges, 2] = bf * n[:, :2].T
        disparity_px[np.isnan(bundle.measured[:, 2])] = np.nan
        slopes[:, np.isnan(disparity_px)] = 0.0
        return replace(bundle, measured=np.column_stack([bundle.measured[:, :2], disparity_px])), slopes
