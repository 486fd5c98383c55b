"""Check of the time between colour and depth images: sensors that are not synchronised bend every map."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from mapper.core.geometry import Array, Transform, inverse, log
from mapper.core.timebase import NS_PER_S
from mapper.odometry.local_map.bundle import Bundle, WindowEstimates, estimated
from mapper.odometry.local_map.depth_surfaces import surface_of
from mapper.odometry.local_map.image_observation import ImageObservation
from mapper.odometry.local_map.pixel_motion import depth_velocity, pixel_velocity

_MIN_WINDOWS, _MIN_OBSERVERS = 3, 3
_STEPS, _MAX_STEP_S = 8, 0.05
_MIN_OFFSET_S, _MIN_SIGMAS = 0.02, 4.0
"""Images so far apart are still paired, by default."""
_MOST_UNKNOWN = 5
"""Keyframes without a known velocity, as where something moves by itself, of the ten of a window. Where depth
is two frames late, many points seem to move by themselves."""
_MAX_APART_S = 0.3
"""Poses farther apart do not determine the velocity in between."""


class DepthOffsetCheck:
    """Estimate of how much later depth images show the scene than the colour images of the same stamps.

    While the camera moves, a depth image that is measured later shows a point elsewhere and nearer or farther
    off. The velocity of each keyframe is known, and planes are fitted to its depth image, so that the offset
    is one more unknown of a bundle adjustment, as that of other sensors is (Furgale, Rehder & Siegwart 2013).
    Constant velocity hardly shows it: all surfaces then have the same displacement.
    """

    def __init__(self) -> None:
        self._offsets_s = WindowEstimates(least=_MIN_WINDOWS)
        self._twists: dict[int, Array] = {}

    @property
    def is_complete(self) -> bool:
        """Whether enough windows were added."""
        return self._offsets_s.are_complete

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
        """Add a window of keyframes with what was observed in them, which is computed only if it is used."""
        twists = [self._twists.get(keyframe) for keyframe in keyframes]
        self._twists.clear()
        if sum(twist is None for twist in twists) > _MOST_UNKNOWN:
            return
        bundle = bundle.of_points_seen_by(_MIN_OBSERVERS)
        depth = ShiftedDepth(bundle, observed, twists)
        self._offsets_s.add(
            *estimated(bundle, depth.corrected, parameters=1, steps=_STEPS, max_step=_MAX_STEP_S)
        )

    def estimate(self) -> tuple[float, float]:
        """Return the offset and its standard deviation, seconds; 0 and infinity where windows are too few."""
        found = self._offsets_s.mean()
        return (0.0, math.inf) if found is None else (float(found[0][0]), float(found[1][0]))

    def contradiction(self) -> str:
        """Return in words that depth images were taken at another time than their stamps; empty if not."""
        offset_s, sigma_s = self.estimate()
        if abs(offset_s) < max(_MIN_OFFSET_S, _MIN_SIGMAS * sigma_s):
            return ""
        return (
            f"depth images show the scene {1e3 * abs(offset_s):.0f} ± {1e3 * sigma_s:.0f} ms "
            f"{'later' if offset_s > 0.0 else 'earlier'} than colour images of the same stamps: add "
            f"{offset_s:.3f} to source.depth_offset_s, which pairs images of one time if there are any, or "
            "synchronise the sensor's two cameras"
        )


class ShiftedDepth:
    """Depth of a bundle's observations at the time of their colour images, where depth was measured later."""

    def __init__(
        self, bundle: Bundle, observed: Iterable[ImageObservation], twists_camera: Sequence[Array | None]
    ) -> None:
        """Fit planes to the depth images.

        Args:
            bundle: Keyframes with their observations.
            observed: What was observed in each of them.
            twists_camera: (6,) velocity of each camera in its own axes, rad/s and m/s; None if it is unknown.
        """
        self._views = []
        for k, (observation, twist) in enumerate(zip(observed, twists_camera, strict=True)):
            if twist is not None and observation.depth_cells is not None:
                edges = np.flatnonzero(bundle.edges[:, 0] == k)
                pixels = observation.pixels[bundle.features[edges]]
                surface = surface_of(observation.depth_cells)
                self._views.append((edges, pixels, surface, twist, observation.depth_delay_s))

    def corrected(self, bundle: Bundle, offset_s: Array) -> tuple[Bundle, Array]:
        """Return the bundle with the disparities of points from where they were when depth was measured.

        Points that were on no plane then have no depth.

        Args:
            bundle: The one of the beginning, perhaps adjusted.
            offset_s: (1,) by how much depth was measured later than its stamps.

        Returns:
            The bundle, and the (1, E, 3) change of its residuals with the offset, px/s.
        """
        disparity_px, slope = self._disparity(bundle, float(offset_s[0]))
        disparity_px[np.isnan(bundle.measured[:, 2])] = np.nan
        measured = np.column_stack([bundle.measured[:, :2], disparity_px])
        slopes = np.column_stack([np.zeros((len(slope), 2)), np.nan_to_num(slope)])
        return replace(bundle, measured=measured), slopes[np.newaxis]

    def _disparity(self, bundle: Bundle, offset_s: float) -> tuple[Array, Array]:
        """Return the (E,) corrected disparities and their derivatives; NaN where they are unknown."""
        disparity_px, slope = np.full((2, len(bundle.edges)), np.nan)
        z_m = bundle.points_camera()[:, 2]
        intrinsics = bundle.intrinsics
        for edges, pixels, surface, twist, delay_s in self._views:
            z = z_m[edges]
            flow = pixel_velocity(pixels, z, intrinsics, twist)
            nearing = depth_velocity(pixels, z, intrinsics, twist) / z**2
            late_s = delay_s + offset_s
            then = pixels + late_s * flow
            planes = surface.planes_at(then)
            rays = np.column_stack([(then - intrinsics[2:4]) / intrinsics[:2], np.ones(len(then))])
            n = planes[:, :3] / np.where(planes[:, 3:] > 0.0, planes[:, 3:], np.nan)
            # A plane's inverse depth is linear in the ray; the point's own has changed since.
            disparity_px[edges] = intrinsics[4] * (np.einsum("ni,ni->n", n, rays) + late_s * nearing)
            slope[edges] = intrinsics[4] * ((n[:, :2] * flow / intrinsics[:2]).sum(axis=1) + nearing)
        return disparity_px, slope
