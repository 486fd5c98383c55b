"""Check of where and when depth images show what the colour images of the same stamps show."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, inverse, log
from mapper.core.timebase import NS_PER_S
from mapper.odometry.local_map.bundle.bundle import Bundle, NestedEstimates, are_significant
from mapper.odometry.local_map.observation.depth_surfaces import surface_of
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.observation.pixel_motion import depth_velocity, pixel_velocity

_MIN_WINDOWS, _MIN_OBSERVERS = 3, 3
_PRIOR_SIGMAS = np.array([0.1, 1.0, 1.0, 1.0])
"""A camera at rest, or at constant velocity, hardly shows the offset."""
_SIGMAS, _MAX_STEPS = [1.0] * 8, np.array([0.05, 0.1, 0.1, 0.1])
"""Enough for depth images of 1.6 times the colour camera's angle of view."""
_LEAST, _MIN_SIGMAS = np.array([0.02, 0.05, np.inf, np.inf]), 4.0
"""fr1_xyz gives −0.015 ± 0.001 s. The two cameras of a sensor differ by 9 % (Kinect 360) to 40 % (RealSense)
in focal length, whose logarithm is compared; shifts alone are not reported."""
_MOST_UNKNOWN = 5
"""Keyframes without a known velocity, as where something moves by itself, of the ten of a window. Where depth
is two frames late, many points seem to move by themselves."""
_MAX_APART_S = 0.3
"""Poses farther apart do not determine the velocity in between."""


class DepthImageCheck:
    """Estimate of how depth images are magnified, shifted and late, relative to the colour images.

    A depth camera of its own with another focal length takes the depth of a point from beside it, so that
    points that several keyframes see are nearer here and farther there. So does a depth image that is
    measured later, while the camera moves: the velocity of each keyframe is known. Depth is read from planes
    that are fitted to the depth image, which makes all of them unknowns of a bundle adjustment (for the
    offset, after Furgale, Rehder & Siegwart 2013). They are estimated together: one falsifies the others.
    """

    def __init__(self) -> None:
        self._found = NestedEstimates(_PRIOR_SIGMAS, _MAX_STEPS, first=1, sigmas=_SIGMAS, least=_MIN_WINDOWS)
        self._twists: dict[int, Array] = {}

    @property
    def is_complete(self) -> bool:
        """Whether enough windows were added."""
        return self._found.are_complete

    def pass_keyframe(
        self, keyframe: int, before: tuple[int, Transform], after: tuple[int, Transform]
    ) -> None:
        """Estimate the velocity of a keyframe from the frames before and after it.

        Args:
            keyframe: Its index.
            before: Stamp and T_camera_world of the frame before.
            after: The same of the frame after.
        """
        elapsed_s = (after[0] - before[0]) / NS_PER_S
        if elapsed_s <= _MAX_APART_S and not self.is_complete:
            moved = log(before[1] @ inverse(after[1]))
            self._twists[keyframe] = np.concatenate(moved) / elapsed_s

    def add(self, bundle: Bundle, keyframes: Sequence[int], observed: Iterable[ImageObservation]) -> None:
        """Add a window of keyframes with what was observed in each of them."""
        twists = [self._twists.get(keyframe) for keyframe in keyframes]
        self._twists.clear()
        if sum(twist is None for twist in twists) > _MOST_UNKNOWN:
            twists = [np.zeros(6)] * len(twists)  # which leaves the offset open
        bundle = bundle.of_points_seen_by(_MIN_OBSERVERS)
        self._found.add(bundle, DepthElsewhere(bundle, observed, twists).read)

    def estimate(self) -> tuple[Array, Array] | None:
        """Return what depth images are off by and its standard deviations; None where windows are too few.

        Both are (4,): how much later than their stamps they were measured, seconds, the logarithm of their
        focal length over that of the colour images, and by how far they are shifted along rows and columns,
        as a share of the colour images' focal length. The last three are taken as 0 where the images may be
        registered.
        """
        return self._found.mean(least=_LEAST[1:], min_sigmas=_MIN_SIGMAS)

    @property
    def are_registered(self) -> bool:
        """Whether depth images may be registered to the colour images."""
        found = self.estimate()
        return found is None or not _is_off(*found)[1]

    def contradictions(self) -> list[str]:
        """Return in words that depth images are not registered, and measured at another time."""
        found = self.estimate()
        if found is None:
            return []
        is_off = _is_off(*found)
        (offset_s, magnification, _, _), (sigma_s, sigma, _, _) = (values.tolist() for values in found)
        sentences = []
        if is_off[1]:
            factor = float(np.exp(magnification))
            sentences.append(
                f"depth images are not registered to the colour images: theirs is {factor:.2f} ± "
                f"{factor * sigma:.2f} times the focal length, so that depth belongs to other pixels: record "
                "registered (aligned) depth, or register the images by the sensor's own software"
            )
        if is_off[0]:
            sentences.append(
                f"depth images show the scene {1e3 * abs(offset_s):.0f} ± {1e3 * sigma_s:.0f} ms "
                f"{'later' if offset_s > 0.0 else 'earlier'} than colour images of the same stamps: add "
                f"{offset_s:.3f} to source.depth_offset_s, which pairs images of one time if there are any, "
                "or synchronise the sensor's two cameras"
            )
        return sentences


def _is_off(values: Array, sigmas: Array) -> NDArray[np.bool_]:
    """Return (4,) which values are more than usual ones."""
    return are_significant(values, sigmas, least=_LEAST, min_sigmas=_MIN_SIGMAS)


class DepthElsewhere:
    """Depth of a bundle's observations where depth images are magnified, shifted and late."""

    def __init__(
        self, bundle: Bundle, observed: Iterable[ImageObservation], twists_camera: Sequence[Array | None]
    ) -> None:
        """Fit planes to the depth images.

        Args:
            bundle: Keyframes with their observations.
            observed: What was observed in each of them.
            twists_camera: (6,) velocity of each camera in its own axes, rad/s and m/s. None if it is unknown:
                its points then have no depth.
        """
        self._views = []
        for k, (observation, twist) in enumerate(zip(observed, twists_camera, strict=True)):
            if twist is not None and observation.depth_cells is not None:
                edges = np.flatnonzero(bundle.edges[:, 0] == k)
                pixels = observation.pixels[bundle.features[edges]]
                surface = surface_of(observation.depth_cells)
                self._views.append((edges, pixels, surface, twist, observation.depth_delay_s))

    def read(self, bundle: Bundle, off: Array) -> tuple[Bundle, Array]:
        """Return the bundle with the disparities of points from where they are in the depth images.

        Points that are on no plane there have no depth.

        Args:
            bundle: The one of the beginning, perhaps adjusted.
            off: (4,) as ``DepthImageCheck.estimate`` returns it.

        Returns:
            The bundle, and the (4, E, 3) change of its residuals, px.
        """
        intrinsics, z_m = bundle.intrinsics, bundle.points_camera()[:, 2]
        focal_px, centre_px, bf = intrinsics[:2], intrinsics[2:4], intrinsics[4]
        magnification = np.exp(off[1])
        disparity_px, slopes = np.full(len(bundle.edges), np.nan), np.zeros((4, len(bundle.edges), 3))
        for edges, pixels, surface, twist, delay_s in self._views:
            z, late_s = z_m[edges], delay_s + off[0]
            flow = magnification * pixel_velocity(pixels, z, intrinsics, twist) / focal_px
            nearing = depth_velocity(pixels, z, intrinsics, twist) / z**2
            from_centre = magnification * (pixels - centre_px) / focal_px + late_s * flow
            ray = from_centre + off[2:]
            planes = surface.planes_at(centre_px + focal_px * ray)
            n = planes[:, :3] / np.where(planes[:, 3:] > 0.0, planes[:, 3:], np.nan)
            # A plane's inverse depth is linear in the ray; the point's own has changed since.
            disparity_px[edges] = bf * ((n[:, :2] * ray).sum(axis=1) + n[:, 2] + late_s * nearing)
            slopes[1, edges, 2] = bf * (n[:, :2] * from_centre).sum(axis=1)
            slopes[2:, edges, 2] = bf * n[:, :2].T
            slopes[0, edges, 2] = bf * ((n[:, :2] * flow).sum(axis=1) + nearing)
        disparity_px[np.isnan(bundle.measured[:, 2])] = np.nan
        slopes[:, np.isnan(disparity_px)] = 0.0
        return replace(bundle, measured=np.column_stack([bundle.measured[:, :2], disparity_px])), slopes
