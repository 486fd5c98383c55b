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
    """Error of the position in every step, however short."""
    path_share: NonNegativeFloat = 0.05
    """Additional error of the position, as a share of the distance driven. Raise it where wheels slip."""
    least_rad: PositiveFloat = 0.01
    """Error of the heading in every step, however short."""
    turn_share: NonNegativeFloat = 0.05
    """Additional error of the heading, as a share of the angle turned. Raise it for a robot that turns on the
    spot."""
    rad_per_m: NonNegativeFloat = 0.02
    """Additional error of the heading per metre driven."""


class WheelFactorsConfig(WheelNoiseConfig):
    """Settings of wheel factors beside another odometry."""

    use: bool = True
    """Connect keyframes by wheel odometry, and predict 2D scans by it, if the log has it."""


class GnssFactorsConfig(Config):
    """Settings of GNSS factors."""

    use: bool = True
    """Put the map in a local east-north-up frame, and let fixes correct the path where it has drifted."""


class GraphConfig(Config):
    """Settings of the pose graph's solver."""

    solve: Literal["batch", "proportional", "none"] = "batch"
    """"batch": least squares over all factors, by GTSAM; "proportional": each loop's error is distributed
    along the path in turn (Somlyai, PhD thesis, §4.3); "none": keep the odometry's own estimate."""
    robust: Literal["gnc", "none"] | KernelKind = "gnc"
    """Rejection of false loops: "gnc" classifies each (Yang et al. 2020), the kernels "cauchy", "huber" and
    "dcs" (Agarwal et al. 2013) weight each by its residual, "none" keeps all. Odometry and wheel factors
    always keep their full weight."""
    robust_width: PositiveFloat = 4.1
    """Residual, in sigmas of all six directions together, beyond which a loop gets less weight. 99 % of
    measurements with consistent information lie within 4.1. "gnc" rejects every loop beyond it, but widens
    the limit for all if the median loop shows that the information is over-confident."""
    initial: Literal["auto", "given", "chordal"] = "auto"
    """Initial poses of the batch solve: the "given" estimates, a "chordal" relaxation that needs none, or
    "auto": the relaxation if the estimates fit badly, no loops are outliers, and its cost is lower."""
    planes: Literal["auto", "off"] = "auto"
    """Adjustment of the poses of 3D scans, after the solve, to the surfaces that they share (Liu, Liu & Zhang
    2023): "auto" keeps it if surfaces of points that took no part become thinner, "off" saves its time."""
    wheels: WheelFactorsConfig = WheelFactorsConfig()
    gnss: GnssFactorsConfig = GnssFactorsConfig()
    max_iterations: PositiveInt = 100
    """Limit for each connected component's last solve."""
