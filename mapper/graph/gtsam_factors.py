"""Nodes and factors as GTSAM's; its tangent order is ours: (rotation, translation)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geometry import Array, Transform
from mapper.graph.config import KernelKind

if TYPE_CHECKING:
    import gtsam

    from mapper.graph.model import BetweenFactor, PoseGraph, PositionFactor

# The anchor only removes the freedom to move the whole component, so at the solution it costs nothing
# whatever its width; a far tighter one would spoil the conditioning for no gain.
_ANCHOR_INFORMATION = np.eye(6) * 1e6  # 1 mrad, 1 mm
LEVEL_SIGMA_RAD = 0.02
"""Error of a levelled world's up: where walls are few it is the normal of the ground, and streets slope."""


@dataclass(frozen=True, slots=True)
class Kernel:
    """Robust kernel: large residuals cost less than their square.

    Attributes:
        kind: "huber" (1964), "cauchy" or "dcs", Dynamic Covariance Scaling (Agarwal et al. 2013).
        width: Norm of the whitened residual, in sigmas, from which the kernel weighs less.
    """

    kind: KernelKind
    width: float

    def estimator(self) -> Any:
        """Return GTSAM's M-estimator; that of DCS takes the square of a width."""
        from gtsam.noiseModel import mEstimator

        if self.kind == "dcs":
            return mEstimator.DCS.Create(self.width**2)
        return {"cauchy": mEstimator.Cauchy, "huber": mEstimator.Huber}[self.kind].Create(self.width)

    def weights(self, chi2: Array) -> Array:
        """Return the weights, 0 … 1, of (N,) squared norms of whitened residuals."""
        estimator = self.estimator()
        return np.array([estimator.weight(norm) for norm in np.sqrt(chi2)])


def between(
    factor: BetweenFactor, *, weight: float = 1.0, kernel: Kernel | None = None
) -> gtsam.BetweenFactorPose3:
    """Return weight · ½ ‖log(T_i_j⁻¹ · T_i⁻¹ · T_j)‖² in the factor's metric, under a kernel if any."""
    import gtsam

    noise: gtsam.noiseModel.Base = _noise(weight * factor.information)
    if kernel is not None:
        noise = gtsam.noiseModel.Robust.Create(kernel.estimator(), noise)
    return gtsam.BetweenFactorPose3(factor.i, factor.j, pose3(factor.T_i_j), noise)


def anchor(
    node: int, T_world_node: Transform, information: Array = _ANCHOR_INFORMATION
) -> gtsam.PriorFactorPose3:
    """Return the prior that holds a component's first node; its information is (6, 6)."""
    import gtsam

    return gtsam.PriorFactorPose3(node, pose3(T_world_node), _noise(information))


def position(
    factor: PositionFactor, *, weight: float = 1.0, kernel: Kernel | None = None
) -> gtsam.GPSFactorArm:
    """Return weight · ½ ‖T_world_node · p_node − p_world‖² in the factor's metric and of its own weight.

    A kernel's width is in sigmas of the measurement, whatever its weight.
    """
    import gtsam

    noise: gtsam.noiseModel.Base = _noise(weight * factor.weight * factor.information)
    if kernel is not None:
        scaled = Kernel(kernel.kind, kernel.width * factor.weight**0.5)
        noise = gtsam.noiseModel.Robust.Create(scaled.estimator(), noise)
    return gtsam.GPSFactorArm(factor.node, factor.position_world, factor.point_node, noise)


def upright(node: int, T_world_node: Transform, sigma_rad: float) -> gtsam.AttitudeFactorPose3:
    """Return the prior that a node keeps its tilt, the world's z being up; its heading is free."""
    import gtsam

    up_node = gtsam.Unit3(T_world_node[2, :3])
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma_rad)
    return gtsam.AttitudeFactorPose3(node, gtsam.Unit3(np.array([0.0, 0.0, 1.0])), noise, up_node)


def gauge(
    graph: PoseGraph, nodes: Collection[int], fixed: int, information: Array = _ANCHOR_INFORMATION
) -> list[gtsam.NonlinearFactor]:
    """Return what determines where a component is: its measured positions and its tilt, else one node."""
    T_world_fixed = graph.T_world_node[fixed]
    measured = [position(factor) for factor in graph.fixes if factor.node in nodes]
    if measured:
        return [*measured, upright(fixed, T_world_fixed, LEVEL_SIGMA_RAD)]
    return [anchor(fixed, T_world_fixed, information)]


def values_of(T_world_node: Mapping[int, Transform], nodes: Iterable[int]) -> gtsam.Values:
    """Return some nodes' poses as GTSAM's values."""
    import gtsam

    values = gtsam.Values()
    for node in nodes:
        values.insert(node, pose3(T_world_node[node]))
    return values


def poses_of(values: gtsam.Values) -> dict[int, Transform]:
    """Return GTSAM's values as poses, by ascending node."""
    import gtsam

    rows = gtsam.utilities.extractPose3(values)  # R row by row, then t
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    return dict(zip(values.keys(), poses, strict=True))


def _noise(information: Array) -> gtsam.noiseModel.Gaussian:
    """Return the noise model of an information matrix; only the symmetric part counts."""
    import gtsam

    return gtsam.noiseModel.Gaussian.Information(0.5 * (information + information.T))


def pose3(T_a_b: Transform) -> gtsam.Pose3:
    """GTSAM ends the whole process when a rotation is off SO(3) by rounding, so it is projected first."""
    import gtsam

    return gtsam.Pose3(gtsam.Rot3.ClosestTo(T_a_b[:3, :3]), T_a_b[:3, 3])


@contextmanager
def solver_errors(what: str) -> Iterator[None]:
    """Raise GTSAM's C++ exceptions, RuntimeErrors of several lines, as GraphErrors of one line.

    Args:
        what: What has failed, the beginning of the message.
    """
    try:
        yield
    except RuntimeError as error:
        raise GraphError(f"{what}: {' '.join(str(error).split())}") from None
