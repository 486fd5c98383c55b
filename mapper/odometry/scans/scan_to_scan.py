"""Scan-to-scan matcher: Hough voting and NDT, without a guess (Nagy, Gálai & Benedek 2016)."""

from mapper.core.geometry import Transform
from mapper.odometry.scans.config import HoughOdometryConfig
from mapper.odometry.scans.scan_matcher import DeskewedScan, Reach
from mapper.registration.base import Aligner
from mapper.registration.factory import aligner_to


class ScanToScanMatcher:
    """Matcher to the last scan, which is the whole map."""

    uses_guess = False

    def __init__(self, config: HoughOdometryConfig) -> None:
        self._config = config.registration
        self.clear()

    def match(self, deskewed: DeskewedScan, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the T_world_body of a scan; None if the registration is not accepted."""
        if self._last is None or reach == "far":  # "near" already has the largest range
            return None
        aligner, T_world_last = self._last
        found = aligner.align(deskewed.scan, T_world_body)
        if not found.converged:
            return None
        T_found: Transform = T_world_last @ found.T_target_source
        return T_found

    def add(self, deskewed: DeskewedScan, T_world_body: Transform, *, is_keyframe: bool) -> None:  # noqa: ARG002
        """Replace the last scan."""
        self._last: tuple[Aligner, Transform] | None = (aligner_to(deskewed.scan, self._config), T_world_body)

    def clear(self) -> None:
        """Drop the last scan."""
        self._last = None
