"""Scan matcher by ICP to the last keyframes (Besl & McKay 1992; Chen & Medioni 1992)."""

from collections import deque
from collections.abc import Mapping

import numpy as np

from mapper.core.geometry import Points, Transform, apply
from mapper.odometry.scans.config import IcpOdometryConfig
from mapper.odometry.scans.scan_matcher import DeskewedScan, Reach
from mapper.registration.correlation import LikelihoodField
from mapper.registration.pair_refinement import Refiner, refine
from mapper.registration.surfaces import Prepared, prepared

_MAP_KEYFRAMES = 10
"""Number of keyframes in the map, whose search tree is built anew for each."""
_CELLS = 0.5  # of the likelihood field, in voxels
_REACH: Mapping[Reach, tuple[float, float]] = {"near": (0.15, 0.06), "far": (0.5, 0.35)}
"""Errors of a predicted planar pose, metres and radians: of wheels that slip, and of a sudden turn."""


class IcpMatcher:
    """Matcher to one cloud of the last keyframes, in world coordinates.

    Planar scans, which ICP pairs wrongly from a degree off, are first moved to where they are most likely.
    """

    uses_guess = True

    def __init__(self, config: IcpOdometryConfig) -> None:
        self._config = config
        self._keyframes: deque[Points] = deque(maxlen=_MAP_KEYFRAMES)
        self._map: Prepared | None = None
        self._field: LikelihoodField | None = None

    def match(self, deskewed: DeskewedScan, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the refined T_world_body of a scan from a guess; None if there is none."""
        if self._map is None:
            return None
        if self._field is not None:
            reach_m, reach_rad = _REACH[reach]
            T_world_body = self._field.best_near(
                deskewed.prepared.points, T_world_body, reach_m=reach_m, reach_rad=reach_rad
            )
        distances_m = self._config.pair_distances_m
        for distance_m in distances_m if reach == "far" else distances_m[-2:]:
            found = refine(
                self._map,
                deskewed.prepared,
                T_world_body,
                kind=self._kind(deskewed),
                pair_distances_m=(distance_m,),
            )
            if not found.converged:
                return None
            T_world_body = found.T_target_source
        return T_world_body

    def add(self, deskewed: DeskewedScan, T_world_body: Transform, *, is_keyframe: bool) -> None:
        """Add a keyframe to the map."""
        if is_keyframe:
            self._keyframes.append(apply(T_world_body, deskewed.prepared.points))
            points = np.concatenate(self._keyframes)
            is_planar = deskewed.scan.is_planar
            self._map = prepared(points, voxel_m=deskewed.prepared.voxel_m, is_planar=is_planar)
            if is_planar:
                self._field = LikelihoodField.of(points, _CELLS * deskewed.prepared.voxel_m)

    def _kind(self, deskewed: DeskewedScan) -> Refiner:
        """Return the method: planes through lines of planar scans would leave z and tilt open."""
        if self._config.distance == "point":
            return "icp"
        return "gicp" if deskewed.scan.is_planar else "plane-icp"

    def clear(self) -> None:
        """Empty the map."""
        self._keyframes.clear()
        self._map = self._field = None
