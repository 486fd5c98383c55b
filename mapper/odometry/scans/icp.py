"""Scan matcher by ICP to the last keyframes (Besl & McKay 1992; Chen & Medioni 1992)."""

from collections import deque

import numpy as np

from mapper.core.geometry import Points, Transform, apply
from mapper.odometry.scans.config import IcpOdometryConfig
from mapper.odometry.scans.scan_matcher import DeskewedScan, Reach
from mapper.registration.refining import refine
from mapper.registration.surfaces import Prepared, prepared

_MAP_KEYFRAMES = 10
"""Number of keyframes in the map, whose search tree is built anew for each."""


class IcpMatcher:
    """Matcher to one cloud of the last keyframes, in world coordinates."""

    uses_guess = True

    def __init__(self, config: IcpOdometryConfig) -> None:
        self._config = config
        self._keyframes: deque[Points] = deque(maxlen=_MAP_KEYFRAMES)
        self._map: Prepared | None = None

    def match(self, deskewed: DeskewedScan, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the refined T_world_body of a scan from a guess; None if there is none."""
        if self._map is None:
            return None
        distances_m = self._config.pair_distances_m
        for distance_m in distances_m if reach == "far" else distances_m[-2:]:
            found = refine(
                self._map,
                deskewed.prepared,
                T_world_body,
                kind="plane-icp" if self._config.distance == "plane" else "icp",
                pair_distances_m=(distance_m,),
                max_iterations=self._config.max_iterations,
            )
            if not found.converged:
                return None
            T_world_body = found.T_target_source
        return T_world_body

    def add(self, deskewed: DeskewedScan, T_world_body: Transform, *, is_keyframe: bool) -> None:
        """Add a keyframe to the map."""
        if is_keyframe:
            self._keyframes.append(apply(T_world_body, deskewed.prepared.points))
            self._map = prepared(np.concatenate(self._keyframes), voxel_m=deskewed.prepared.voxel_m)

    def clear(self) -> None:
        """Empty the map."""
        self._keyframes.clear()
        self._map = None
