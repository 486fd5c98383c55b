"""Each scan against the one before it, without a guess (Nagy, Gálai & Benedek; C6)."""

from mapper.core.geometry import Transform
from mapper.odometry.scan_to_map.config import HoughOdometryConfig
from mapper.odometry.scan_to_map.matching import Reach, Sweep
from mapper.registration.base import Aligner
from mapper.registration.factory import build_registration


class ConsecutiveMatcher:
    """The map is the last scan."""

    def __init__(self, config: HoughOdometryConfig) -> None:
        self._registration = build_registration(config.registration)
        self.clear()

    def match(self, sweep: Sweep, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the T_world_body of a scan; None if the registration is not to be trusted."""
        if self._last is None or reach == "far":  # it always reaches as far as it can
            return None
        aligner, T_world_last = self._last
        found = aligner.align(sweep.scan, T_world_body)
        if not found.converged:
            return None
        T_found: Transform = T_world_last @ found.T_target_source
        return T_found

    def add(self, sweep: Sweep, T_world_body: Transform, *, is_keyframe: bool) -> None:  # noqa: ARG002
        """Keep a scan as the last one."""
        self._last: tuple[Aligner, Transform] | None = self._registration.prepare(sweep.scan), T_world_body

    def clear(self) -> None:
        """Forget the last scan."""
        self._last = None
