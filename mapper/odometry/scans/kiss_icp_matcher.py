"""Scan matcher by KISS-ICP's own library (Vizzo et al. 2023)."""

from typing import Any

import numpy as np

from mapper.core.geometry import Array, Points, Transform, inverse, is_rigid
from mapper.odometry.scans.config import KissOdometryConfig
from mapper.odometry.scans.scan_matcher import DeskewedScan, Reach
from mapper.runtime.extras import extra

_MAX_POINTS_PER_VOXEL, _CONVERGENCE = 20, 1e-4  # the library's defaults


class KissMatcher:
    """Matcher with the library's map, registration and adaptive threshold, but without its motion model."""

    uses_guess = True

    def __init__(self, config: KissOdometryConfig) -> None:
        with extra("peers", "odometry.kind=kiss-icp"):
            from kiss_icp.config import KISSConfig
            from kiss_icp.registration import get_registration

        self._config = config
        self._settings = KISSConfig()
        self._settings.data.max_range = config.max_range_m
        self._settings.mapping.voxel_size = config.map_voxel_m
        self._settings.mapping.max_points_per_voxel = _MAX_POINTS_PER_VOXEL
        self._settings.registration.convergence_criterion = _CONVERGENCE
        self._settings.registration.max_num_threads = 1  # more threads would add sums in a varying order
        self._settings.adaptive_threshold.initial_threshold = config.initial_threshold_m
        self._settings.adaptive_threshold.min_motion_th = config.min_motion_m
        self._registration = get_registration(self._settings)
        self._T_world_guess: Transform | None = None
        self.clear()

    def match(self, deskewed: DeskewedScan, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the refined T_world_body of a scan from a guess; None if it is not rigid."""
        source = self._thinned(self._thinned(deskewed.scan.points_body.astype(np.float64), 0.5), 1.5)
        sigma_m = self._settings.adaptive_threshold.initial_threshold
        if reach == "near":
            sigma_m = self._threshold.get_threshold()
        T_found: Array = self._registration.align_points_to_map(
            points=source,
            voxel_map=self._map,
            initial_guess=T_world_body,
            max_correspondance_distance=3.0 * sigma_m,
            kernel=sigma_m,
        )
        if not is_rigid(T_found):
            return None
        self._T_world_guess = T_world_body
        return T_found

    def add(self, deskewed: DeskewedScan, T_world_body: Transform, *, is_keyframe: bool) -> None:  # noqa: ARG002
        """Add any tracked scan to the map, and the error of its predicted pose to the adaptive threshold."""
        if self._T_world_guess is not None:
            self._deviations.append(inverse(self._T_world_guess) @ T_world_body)
            self._threshold.update_model_deviation(self._deviations[-1])
            self._T_world_guess = None
        self._map.update(self._thinned(deskewed.scan.points_body.astype(np.float64), 0.5), T_world_body)

    def clear(self) -> None:
        """Empty the map."""
        from kiss_icp.mapping import get_voxel_hash_map
        from kiss_icp.threshold import get_threshold_estimator

        self._map = get_voxel_hash_map(self._settings)
        self._threshold = get_threshold_estimator(self._settings)
        self._deviations: list[Transform] = []
        self._T_world_guess = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what the library's objects were given: a map takes its points again, in their order."""
        return {
            "config": self._config,
            "points": self._map.point_cloud(),
            "deviations": self._deviations,
            "guess": self._T_world_guess,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the library's objects again."""
        self.__init__(state["config"])  # type: ignore[misc]
        if len(state["points"]):
            self._map.add_points(state["points"])
        for deviation in state["deviations"]:
            self._threshold.update_model_deviation(deviation)
        self._deviations, self._T_world_guess = state["deviations"], state["guess"]

    def _thinned(self, points: Points, ratio: float) -> Points:
        from kiss_icp.voxelization import voxel_down_sample

        thinned: Points = voxel_down_sample(points, ratio * self._settings.mapping.voxel_size)
        return thinned
