"""Scan to map by voxelised GICP (Koide, Yokozuka, Oishi & Banno 2021), with small_gicp."""

from typing import Any

import numpy as np

from mapper.config.scan_odometry import GicpOdometryConfig
from mapper.geometry import Transform, is_rigid
from mapper.odometry.scan_to_map.matching import Reach, Sweep

_CLEAR_CYCLE = 10
_STEP_CELLS = 0.01  # shorter steps end the refinement: what they would add is below a scan's noise


class GicpMatcher:
    """Two maps of Gaussians: fine cells for precision, coarse ones for scans whose motion was not foreseen.

    Only keyframes enter them: a vehicle that waits must not outvote the place it waits in.
    """

    def __init__(self, config: GicpOdometryConfig) -> None:
        self._config = config
        self.clear()

    def match(self, sweep: Sweep, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the T_world_body of a scan from a guess; None if the method cannot say."""
        if reach == "far":
            coarse = self._align(self._coarse, self._config.coarse_cell_m, sweep, T_world_body)
            if coarse is None:
                return None
            T_world_body = coarse
        return self._align(self._fine, self._config.cell_m, sweep, T_world_body)

    def add(self, sweep: Sweep, T_world_body: Transform, *, is_keyframe: bool) -> None:
        """Take a keyframe into the maps."""
        if is_keyframe:
            self._fine.insert(sweep.prepared.cloud, T_world_body)
            self._coarse.insert(sweep.prepared.cloud, T_world_body)

    def clear(self) -> None:
        """Forget the maps."""
        self._fine = self._map(self._config.cell_m)
        self._coarse = self._map(self._config.coarse_cell_m)

    def _map(self, cell_m: float) -> Any:
        import small_gicp

        cells = small_gicp.GaussianVoxelMap(cell_m)
        cells.set_lru(self._config.map_keyframes, _CLEAR_CYCLE)
        return cells

    def _align(self, cells: Any, cell_m: float, sweep: Sweep, T_world_body: Transform) -> Transform | None:
        import small_gicp

        result = small_gicp.align(
            cells,
            sweep.prepared.cloud,
            T_world_body,
            max_correspondence_distance=cell_m,
            num_threads=1,  # sums are added up in the order of the points
            max_iterations=self._config.max_iterations,
            translation_epsilon=_STEP_CELLS * cell_m,
        )
        T_found = np.asarray(result.T_target_source)
        return T_found if result.num_inliers > 0 and is_rigid(T_found) else None
