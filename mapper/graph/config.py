"""Settings of the pose graph's solver and of wheel factors."""

from typing import Literal

from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapper.core.config import Config

KernelKind = Literal["cauchy", "huber", "dcs"]


class WheelNoiseConfig(Config):
    """Noise of wheel odometry."""

    max_gap_s: PositiveFloat = 0.2
    """Between two readings; in a longer gap it is not known where the wheels were."""
    least_m: PositiveFloat = 0.01
    path_share: NonNegativeFloat = 0.05
    """Error of the position, as a share of the metres driven."""
    least_rad: PositiveFloat = 0.01
    turn_share: NonNegativeFloat = 0.05
    """Error of the heading, as a share of the radians turned."""
    rad_per_m: NonNegativeFloat = 0.02
    """Error of the heading per metre driven."""


class WheelFactorsConfig(WheelNoiseConfig):
    """Settings of wheel factors beside another odometry."""

    use: bool = True
    """Tie keyframes by the wheels, where a log has them."""


class GraphConfig(Config):
    """The back end."""

    solve: Literal["batch", "proportional", "none"] = "batch"
    """"batch": least squares over all factors, by GTSAM; "proportional": each loop is spread along the path
    in turn (A9); "none": keep the odometry's own estimate (A7)."""
    robust: Literal["gnc", "none"] | KernelKind = "gnc"
    """What keeps false loops from bending the map: "gnc" decides about each (Yang et al. 2020), the kernels
    "cauchy", "huber" and "dcs" (Agarwal et al. 2013) weigh each by its residual, "none" believes all.
    Odometry and wheels are always believed."""
    robust_width: PositiveFloat = 4.1
    """Residual, in sigmas of all six directions together, from which a loop counts less. 99 % of honest
    measurements lie within 4.1. "gnc" lets none count beyond, but widens it for all by as much as the
    median loop shows information to be over-confident."""
    initial: Literal["auto", "given", "chordal"] = "auto"
    """Where the batch solve begins: at the "given" estimates, at a "chordal" relaxation that needs none, or
    "auto": at the relaxation where the estimates fit badly, nothing is in doubt, and it serves better."""
    wheels: WheelFactorsConfig = WheelFactorsConfig()
    max_iterations: PositiveInt = 100
    """Of each connected component's last descent."""
    relative_error: PositiveFloat = 1e-8
    """Stop when an iteration improves the error by less than this share."""
