"""Relative-pose factors between keyframes from wheel odometry."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

from mapper.core.geometry import Transform, inverse
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.graph.config import WheelFactorsConfig, WheelNoiseConfig
from mapper.graph.model import BetweenFactor, Origin, PoseSigmas
from mapper.sensing.wheel_kinematics import Odometer, pose_at


@dataclass(frozen=True, slots=True, eq=False)
class WheelNode:
    """A node, its time, and its pose by wheel odometry: (4, 4) T_odom_body."""

    node: int
    stamp_ns: int
    T_odom_body: Transform


def wheel_factors(
    stamps_ns: Mapping[int, int], wheels: Trajectory | None, config: WheelFactorsConfig
) -> list[BetweenFactor]:
    """Return a factor between every two nodes that follow each other in time and whose wheel poses are known.

    Args:
        stamps_ns: Time of every node, nanoseconds.
        wheels: T_odom_body; None without wheels.
        config: Whether they are used, and their noise.
    """
    if wheels is None or not config.use:
        return []
    max_gap_ns = round(config.max_gap_s * NS_PER_S)
    known = [
        WheelNode(node, stamp_ns, T_odom_node)
        for node, stamp_ns in sorted(stamps_ns.items(), key=lambda item: item[1])
        if (T_odom_node := pose_at(wheels, stamp_ns, max_gap_ns=max_gap_ns)) is not None
    ]
    odometer = Odometer(wheels)
    return [wheel_factor(i, j, odometer, config, origin="wheel") for i, j in pairwise(known)]


def wheel_factor(
    i: WheelNode, j: WheelNode, odometer: Odometer, noise: WheelNoiseConfig, *, origin: Origin
) -> BetweenFactor:
    """Return the factor from a node to a later one.

    The error grows with the path length and the turning in between, not with the displacement (Thrun,
    Burgard & Fox 2005, §5.4); wheels measure no height and no tilt, which get the same sigmas.
    """
    path_m, turn_rad = odometer.between(i.stamp_ns, j.stamp_ns)
    sigmas = PoseSigmas(
        rotation_rad=noise.least_rad + noise.turn_share * turn_rad + noise.rad_per_m * path_m,
        translation_m=noise.least_m + noise.path_share * path_m,
    )
    return BetweenFactor(i.node, j.node, inverse(i.T_odom_body) @ j.T_odom_body, sigmas.information, origin)
