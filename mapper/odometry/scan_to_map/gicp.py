"""Scan to map by voxelised GICP (Koide, Yokozuka, Oishi & Banno 2021)."""

from mapper.core.geometry import Transform
from mapper.odometry.scan_to_map.config import GicpOdometryConfig
from mapper.odometry.scan_to_map.matching import Reach, Sweep
from mapper.registration.gaussian_cells import GaussianCells

_MAP_KEYFRAMES = 100
"""Cells that so many keyframes in a row have not touched are removed, so that the map stays local."""
_STEP_CELLS = 0.01  # shorter steps end the refinement: what they would add is below a scan's noise
_STEP_RAD = 0.002


class GicpMatcher:
    """Two maps of Gaussians: a scan is placed in coarse cells first, then in fine ones.

    Coarse cells reach as far as a hand's turns are unforeseen; on a bare yard the overlap would not tell that
    fine ones alone ended beside the truth. Only keyframes enter the maps: who waits must not outvote
    the place where they wait.
    """

    def __init__(self, config: GicpOdometryConfig) -> None:
        self._config = config
        self.clear()

    def match(self, sweep: Sweep, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the T_world_body of a scan from a guess; None if the method cannot say."""
        if reach == "far":  # it always reaches as far as it can
            return None
        coarse = self._aligned(self._coarse, sweep, T_world_body)
        return None if coarse is None else self._aligned(self._fine, sweep, coarse)

    def add(self, sweep: Sweep, T_world_body: Transform, *, is_keyframe: bool) -> None:
        """Take a keyframe into the maps."""
        if is_keyframe:
            self._fine.insert(sweep.prepared, T_world_body)
            self._coarse.insert(sweep.prepared, T_world_body)

    def clear(self) -> None:
        """Forget the maps."""
        self._fine = GaussianCells(self._config.cell_m, remembered=_MAP_KEYFRAMES)
        self._coarse = GaussianCells(self._config.coarse_cell_m, remembered=_MAP_KEYFRAMES)

    def _aligned(self, cells: GaussianCells, sweep: Sweep, T_world_body: Transform) -> Transform | None:
        return cells.align(
            sweep.prepared,
            T_world_body,
            max_iterations=self._config.max_iterations,
            step_rad=_STEP_RAD,
            step_m=_STEP_CELLS * cells.cell_m,
        )
