"""Relative-pose factors between keyframes from wheel odometry, and motions that wheels rule out."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from mapper.core.geometry import Transform, inverse
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.core.units import OTHER_UNIT
from mapper.graph.components import component_numbers
from mapper.graph.config import WheelFactorsConfig, WheelNoiseConfig
from mapper.graph.measurement_covariance import Comparison, compare
from mapper.graph.model import BetweenFactor, Origin, PoseGraph, PoseSigmas
from mapper.sensing.wheel_kinematics import Odometer, pose_at


@dataclass(frozen=True, slots=True, eq=False)
class WheelNode:
    """A node, its time, and its pose by wheel odometry: (4, 4) T_odom_body."""

    node: int
    stamp_ns: int
    T_odom_body: Transform


_SLACK_M, _SLACK_RAD = 0.2, 0.1
"""Difference to the wheels' motion that is possible without noise: by clocks, mountings, uneven floors."""


class WheelMeasurements:
    """Wheel measurements: factors between the nodes of another odometry, in the order in which these come."""

    def __init__(self, wheels: Trajectory | None, config: WheelFactorsConfig) -> None:
        """Start before the first node.

        Args:
            wheels: T_odom_body; None without wheels.
            config: Whether they are used, and their noise.
        """
        self._config = config
        self._wheels = wheels if config.use else None
        self._odometer = None if self._wheels is None else Odometer(self._wheels)
        self._last: WheelNode | None = None

    def link(self, node: int, stamp_ns: int) -> list[BetweenFactor]:
        """Return the factor to a new node, in time order, from the last one whose wheel pose is known."""
        here = self._at(node, stamp_ns)
        if here is None:
            return []
        last, self._last = self._last, here
        return [] if last is None else [self._factor(last, here)]

    def contradiction(self, T_begin_end: Transform, begin_ns: int, end_ns: int) -> str:
        """Return why a body's motion (4, 4) between two times cannot be, by the wheels; empty if it can."""
        begin, end = self._at(0, begin_ns), self._at(1, end_ns)
        if begin is None or end is None:
            return ""
        comparison = _compared(T_begin_end, self._factor(begin, end))
        return "" if comparison.is_possible else f"{comparison}, by the wheels"

    def _at(self, node: int, stamp_ns: int) -> WheelNode | None:
        if self._wheels is None:
            return None
        max_gap_ns = round(self._config.max_gap_s * NS_PER_S)
        T_odom_body = pose_at(self._wheels, stamp_ns, max_gap_ns=max_gap_ns)
        return None if T_odom_body is None else WheelNode(node, stamp_ns, T_odom_body)

    def _factor(self, i: WheelNode, j: WheelNode) -> BetweenFactor:
        assert self._odometer is not None  # there are wheel poses
        return wheel_factor(i, j, self._odometer, self._config, origin="wheel")


def wheel_conflict(graph: PoseGraph, driven: Sequence[BetweenFactor]) -> str:
    """Return a sentence about wheel factors that contradict the odometry; empty if none does.

    Args:
        graph: Nodes at the odometry's estimates, with its factors.
        driven: Wheel factors between them; those between parts that the odometry left unconnected are new.
    """
    part_of = component_numbers(graph.with_factors(f for f in graph.factors if f.origin == "odometry"))
    both = [factor for factor in driven if part_of[factor.i] == part_of[factor.j]]
    steps = [inverse(graph.T_world_node[factor.i]) @ graph.T_world_node[factor.j] for factor in both]
    comparisons = [_compared(T_i_j, factor) for T_i_j, factor in zip(steps, both, strict=True)]
    wrong = [comparison for comparison in comparisons if not comparison.is_possible]
    if not wrong:
        return ""
    miss_m = median(comparison.translation_m for comparison in wrong)
    miss_rad = median(comparison.rotation_rad for comparison in wrong)
    moved_m = np.linalg.norm([T_i_j[:3, 3] for T_i_j in steps], axis=1)
    driven_m = np.linalg.norm([factor.T_i_j[:3, 3] for factor in both], axis=1)
    ratio = float(np.median(driven_m / np.maximum(moved_m, _SLACK_M / 10.0)))
    question = "did they slip, is their mounting or clock wrong, or did the odometry jump?"
    if not 1.0 / OTHER_UNIT < ratio < OTHER_UNIT and np.median(driven_m) > _SLACK_M:
        question = (
            f"by them steps are {ratio:.2g} times as long as by the frames, whose lengths may not be metres"
        )
    return (
        f"the wheels contradict the odometry in {len(wrong)} of {len(both)} steps between keyframes, by "
        f"{miss_m:.2f} m and {miss_rad:.2f} rad (median): {question}"
    )


def _compared(T_i_j: Transform, driven: BetweenFactor) -> Comparison:
    covariance = np.asarray(np.linalg.inv(driven.information), np.float64)
    return compare(T_i_j, driven.T_i_j, covariance, slack_m=_SLACK_M, slack_rad=_SLACK_RAD)


def wheel_factor(
    i: WheelNode, j: WheelNode, odometer: Odometer, noise: WheelNoiseConfig, *, origin: Origin
) -> BetweenFactor:
    """Return the factor from a node to a later one.

    The error grows with the path length and the turning in between, not with the displacement (Thrun,
    Burgard & Fox 2005, §5.4); wheels measure no height and no tilt, which get the same sigmas.

    Args:
        i: The node.
        j: The later node.
        odometer: Path length and turning between their times.
        noise: Standard deviations, at least, by the path and by the turning.
        origin: Origin of the factor: "odometry" where wheels are the odometry.
    """
    path_m, turn_rad = odometer.between(i.stamp_ns, j.stamp_ns)
    sigmas = wheel_sigmas(noise, path_m, turn_rad)
    return BetweenFactor(i.node, j.node, inverse(i.T_odom_body) @ j.T_odom_body, sigmas.information, origin)


def wheel_sigmas(noise: WheelNoiseConfig, path_m: float, turn_rad: float) -> PoseSigmas:
    """Return the standard deviations of a motion by the wheels along a path that turns."""
    return PoseSigmas(
        rotation_rad=noise.least_rad + noise.turn_share * turn_rad + noise.rad_per_m * path_m,
        translation_m=noise.least_m + noise.path_share * path_m,
    )
