"""First sweep of a map, deskewed by the motion that the second scan shows."""

import numpy as np

from mapper.core.deskew import STILL, Twist
from mapper.odometry.scan_to_map.placed_scan import PlacedScan
from mapper.odometry.scan_to_map.scan_observation import ScanObservation
from mapper.odometry.scan_to_map.scan_placement import ScanPlacement
from mapper.odometry.scan_to_map.scan_state import ScanState

_CLEAR = 0.5  # score of a log's second scan; in rooms 0.6 to 0.8 is usual, in fields less
_FIRST_TURNS_RADPS = (1.0, -1.0, 2.0, -2.0, 4.0, -4.0)  # about the vertical, at the beginning of a map
_SHOWN = 0.2  # share of such a turn that the poses show at least, should it end soon after the first sweep


class FirstSweep:
    """First sweep of a map, in unknown motion until a second scan is placed.

    Attributes:
        first: The scan; None once a second one was placed.
    """

    def __init__(self, state: ScanState, placement: ScanPlacement) -> None:
        self.first: ScanObservation | None = None
        self._state = state
        self._placement = placement
        self._has_tried_turns = False

    def restart(self, first: ScanObservation) -> None:
        """Begin with the first scan of a new map."""
        self.first, self._has_tried_turns = first, False

    def placed_after(
        self, first: ScanObservation, second: ScanObservation, placed: PlacedScan | None
    ) -> PlacedScan | None:
        """Place a map's first two scans again, with the motion during their sweeps that the second one shows.

        Where it does not fit clearly, other motions are tried once: the log may begin with a fast turn. Scans
        that are bent alike fit each other, so a motion counts only where the poses show part of it.

        Args:
            first: The first scan.
            second: The second one.
            placed: Its pose in the map as it is; None if it was not found.

        Returns:
            Its pose in the map that was begun again; None if it is not found.
        """
        if first.scan.times_s is None:
            return placed
        twist = STILL
        if placed is not None:
            twist = self._state.motion.mean_twist(second.middle_ns, placed.found.T_world_middle)
            placed = self._begun(first, second, twist)
            if placed is not None and placed.found.score >= _CLEAR:
                return placed
        if self._has_tried_turns:
            return placed
        self._has_tried_turns = True
        best = -np.inf if placed is None else placed.found.score
        for turning_radps in _FIRST_TURNS_RADPS:
            tried = Twist(np.array([0.0, 0.0, turning_radps]), np.zeros(3))
            for _ in range(2):  # the second time with the mean velocity to the pose that was found
                found = self._begun(first, second, tried)
                if found is None:
                    break
                mean = self._state.motion.mean_twist(second.middle_ns, found.found.T_world_middle)
                shown = mean.rotation_radps @ tried.rotation_radps
                is_shown = shown >= _SHOWN * tried.rotation_radps @ tried.rotation_radps
                if is_shown and found.found.score > best:
                    twist, best = tried, found.found.score
                tried = mean
        return self._begun(first, second, twist)

    def _begun(self, first: ScanObservation, second: ScanObservation, twist: Twist) -> PlacedScan | None:
        """Begin a map with its first scan, deskewed by a velocity, and place the second one in it."""
        turning_radps = float(np.linalg.norm(twist.rotation_radps))
        self._state.begin_again(first, twist, turning_radps)  # it may just have begun to turn
        return self._placement.place(second)
