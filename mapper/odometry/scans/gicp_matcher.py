"""Scan matcher by voxelised GICP (Koide, Yokozuka, Oishi & Banno 2021)."""

from mapper.core.geometry import Transform
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.odometry.scans.scan_matcher import DeskewedScan, Reach
from mapper.registration.gaussian_cells import GaussianCells

_MAP_KEYFRAMES = 100
"""Cells that this number of keyframes in a row have not touched are removed, so that the map stays local."""
_STEP_CELLS = 0.01  # shorter steps end the refinement: they are below a scan's noise
_STEP_RAD = 0.002
_MOST_STEPS = 30


class GicpMatcher:
    """Matcher to two maps of Gaussians: coarse cells first, then fine ones.

    Coarse cells have the range that a hand-held scanner's sudden turns need; with fine ones alone a scan of a
    bare yard ended in a wrong pose that the overlap did not reveal. Only keyframes enter the maps, so that a
    standing sensor does not outweigh the rest of the map.
    """

    uses_guess = True

    def __init__(self, config: GicpOdometryConfig) -> None:
        self._config = config
        self.clear()

    def match(self, deskewed: DeskewedScan, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the refined T_world_body of a scan from a guess; None if there is none."""
        if reach == "far":  # "near" already has the largest range
            return None
        coarse = self._aligned(self._coarse, deskewed, T_world_body)
        return None if coarse is None else self._aligned(self._fine, deskewed, coarse)

    def add(self, deskewed: DeskewedScan, T_world_body: Transform, *, is_keyframe: bool) -> None:
        """Add a keyframe to the maps."""
        if is_keyframe:
            self._fine.insert(deskewed.prepared, T_world_body)
            self._coarse.insert(deskewed.prepared, T_world_body)

    def clear(self) -> None:
        """Empty the maps."""
        self._fine = GaussianCells(self._config.cell_m, kept_clouds=_MAP_KEYFRAMES)
        self._coarse = GaussianCells(self._config.coarse_cell_m, kept_clouds=_MAP_KEYFRAMES)

    def _aligned(
        self, cells: GaussianCells, deskewed: DeskewedScan, T_world_body: Transform
    ) -> Transform | None:
        return cells.align(
            deskewed.prepared,
            T_world_body,
            max_iterations=_MOST_STEPS,
            step_rad=_STEP_RAD,
            step_m=_STEP_CELLS * cells.cell_m,
        )
