"""What the wheels say of the way between keyframes, as factors."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from mapper.config.graph import WheelFactorsConfig
from mapper.geometry import Array, inverse
from mapper.graph.model import BetweenFactor, PoseSigmas
from mapper.sensing.wheels import pose_at
from mapper.timebase import NS_PER_S
from mapper.trajectory import Trajectory


def wheel_factors(
    stamps_ns: Mapping[int, int], wheels: Trajectory | None, config: WheelFactorsConfig
) -> list[BetweenFactor]:
    """Return a factor between every two nodes that follow each other in time and whose wheel poses are known.

    The error grows with the distance and the turn on the way, not with where it ended (Thrun, Burgard &
    Fox 2005, §5.4); wheels know of no height and no tilt, which are as uncertain as the rest.

    Args:
        stamps_ns: Time of every node.
        wheels: T_odom_body; None without wheels.
        config: Whether they count, and how much.
    """
    if wheels is None or not config.use:
        return []
    max_gap_ns = round(config.max_gap_s * NS_PER_S)
    known = [
        (node, stamp_ns, T_odom_node)
        for node, stamp_ns in sorted(stamps_ns.items(), key=lambda item: item[1])
        if (T_odom_node := pose_at(wheels, stamp_ns, max_gap_ns=max_gap_ns)) is not None
    ]
    path_m, turn_rad = _ways(wheels, np.array([stamp_ns for _, stamp_ns, _ in known], dtype=np.int64))
    factors = []
    for k, ((i, _, T_odom_i), (j, _, T_odom_j)) in enumerate(pairwise(known)):
        sigmas = PoseSigmas(
            rotation_rad=config.least_rad + config.turn_share * turn_rad[k] + config.rad_per_m * path_m[k],
            translation_m=config.least_m + config.path_share * path_m[k],
        )
        factors.append(BetweenFactor(i, j, inverse(T_odom_i) @ T_odom_j, sigmas.information, "wheel"))
    return factors


def _ways(wheels: Trajectory, stamps_ns: Array) -> tuple[Array, Array]:
    """Return the metres driven and the radians turned between each time and the next."""
    steps_m = np.linalg.norm(np.diff(wheels.positions_world, axis=0), axis=1)
    chords = np.linalg.norm(np.diff(wheels.T_world_body[:, :3, :3], axis=0), axis=(1, 2))
    steps_rad = 2.0 * np.arcsin(np.minimum(chords / np.sqrt(8.0), 1.0))  # |R_a − R_b|_F = √8 sin(angle / 2)
    start_ns = wheels.stamps_ns[0]  # nanoseconds since 1970 are too many for a float
    known, wanted = wheels.stamps_ns - start_ns, stamps_ns - start_ns
    path_m, turn_rad = (
        np.diff(np.interp(wanted, known, np.concatenate([[0.0], np.cumsum(steps)])))
        for steps in (steps_m, steps_rad)
    )
    return path_m, turn_rad
