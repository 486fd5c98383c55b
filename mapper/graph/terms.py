"""Our nodes and factors in GTSAM's words; its tangent order is ours: (rotation, translation)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from mapper.geometry import Array, Transform
from mapper.graph.model import BetweenFactor, PoseSigmas

if TYPE_CHECKING:
    import gtsam

# The anchor only removes the freedom to move the whole component, so at the solution it costs nothing
# whatever its width; a far tighter one would spoil the conditioning for no gain.
_ANCHOR = PoseSigmas(rotation_rad=1e-3, translation_m=1e-3)


def between(factor: BetweenFactor, *, weight: float = 1.0) -> gtsam.BetweenFactorPose3:
    """Return weight · ½ ‖log(T_i_j⁻¹ · T_i⁻¹ · T_j)‖² in the factor's metric."""
    import gtsam

    information = weight * factor.information
    return gtsam.BetweenFactorPose3(factor.i, factor.j, pose3(factor.T_i_j), noise(information))


def anchor(node: int, T_world_node: Transform) -> gtsam.PriorFactorPose3:
    """Return the prior that holds a component's first node."""
    import gtsam

    return gtsam.PriorFactorPose3(node, pose3(T_world_node), noise(_ANCHOR.information))


def values_of(T_world_node: Mapping[int, Transform], nodes: Iterable[int]) -> gtsam.Values:
    """Return some nodes' poses as GTSAM's values."""
    import gtsam

    values = gtsam.Values()
    for node in nodes:
        values.insert(node, pose3(T_world_node[node]))
    return values


def noise(information: Array) -> gtsam.noiseModel.Gaussian:
    """Return the noise model of a (6, 6) information matrix; only the symmetric part counts."""
    import gtsam

    return gtsam.noiseModel.Gaussian.Information(0.5 * (information + information.T))


def pose3(T_a_b: Transform) -> gtsam.Pose3:
    """GTSAM ends the whole process when a rotation is off SO(3) by rounding, so it is projected first."""
    import gtsam

    return gtsam.Pose3(gtsam.Rot3.ClosestTo(T_a_b[:3, :3]), np.ascontiguousarray(T_a_b[:3, 3]))
