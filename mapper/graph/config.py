"""Settings of the pose graph's solver and of wheel factors."""

from typing import Literal

from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapper.core.config import Config

KernelKind = Literal["cauchy", "huber", "dcs"]


class WheelNoiseConfig(Config):
    """Noise of wheel odometry."""

    max_gap_s: PositiveFloat = 0.2
    """Largest gap between two readings across which wheel poses are interpolated."""
    least_m: PositiveFloat = 0.01
    """Error of the position that every step has, also a short one."""
    path_share: NonNegativeFloat = 0.05
    """Error of the position that is added, as a share of the metres driven. More, where wheels slip."""
    least_rad: PositiveFloat = 0.01
    """Error of the heading that every step has, also a short one."""
    turn_share: NonNegativeFloat = 0.05
    """Error of the heading that is added, as a share of the radians turned. More for a robot that turns on
    the spot."""
    rad_per_m: NonNegativeFloat = 0.02
    """Error of the heading that is added per metre driven."""


class WheelFactorsConfig(WheelNoiseConfig):
    """Settings of wheel factors beside another odometry."""

    use: bool = True
    """Connect keyframes by wheel odometry, where a log has it."""


class GraphConfig(Config):
    """Settings of the pose graph's solver."""

    solve: Literal["batch", "proportional", "none"] = "batch"
    """"batch": least squares over all factors, by GTSAM; "proportional": each loop's error is distributed
    along the path in turn (Somlyai, PhD thesis, §4.3); "none": keep the odometry's own estimate."""
    robust: Literal["gnc", "none"] | KernelKind = "gnc"
    """Rejection of false loops: "gnc" classifies each (Yang et al. 2020), the kernels
    "cauchy", "huber" and "dcs" (Agarwal et al. 2013) weigh each by its residual, "none" keeps all.
    Odometry and wheel factors are never weighed down."""
    robust_width: PositiveFloat = 4.1
    """Residual, in sigmas of all six directions together, from which a loop weighs less. 99 % of measurements
    with consistent information lie within 4.1. "gnc" rejects every loop beyond, but widens the limit for all
    by as much as the median loop shows information to be over-confident."""
    initial: Literal["auto", "given", "chordal"] = "auto"
    """Where the batch solve begins: at the "given" estimates, at a "chordal" relaxation that needs none, or
    "auto": the relaxation, where the estimates fit badly, loops are no outliers, and its cost is lower."""
    wheels: WheelFactorsConfig = WheelFactorsConfig()
    max_iterations: PositiveInt = 100
    """Limit for each connected component's last solve."""
    relative_error: PositiveFloat = 1e-8
    """Stop when an iteration improves the error by less than this share."""
