"""Settings of the line laser: its calibration file, stripe detection, maps and simulation."""

from typing import Annotated, Self

from pydantic import Field, NegativeFloat, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from mapper.core.config import Config

Covariance = tuple[tuple[float, float], tuple[float, float]]
Level = Annotated[int, Field(ge=1, le=255)]
"""Brightness of a pixel of 8 bits."""


class RangeLaw(Config):
    """υ = scale_mm · p^exponent, p the stripe's height in the image, 0 at the bottom and 100 at the top."""

    scale_mm: PositiveFloat
    exponent: NegativeFloat
    covariance: Covariance | None = None
    """Covariance of (ln scale, exponent); None if unknown."""


class LateralLaw(Config):
    """φ = x / (slope · y + offset) cm, x and y in px from the image's middle column and from its bottom."""

    slope: PositiveFloat
    offset: float
    covariance: Covariance | None = None
    """Covariance of (slope, offset)."""


class VehicleConfig(Config):
    """Settings of the vehicle that carries the sensor."""

    wheelbase_m: PositiveFloat | None = None
    """Distance between the axles; required for encoder readings."""
    sensor_x_m: float = 0.0
    """Distance from the rear axle ahead to the origin of ranges."""


class LineLaserCalibration(Config):
    """Calibration: from the stripe's pixel to a point before the vehicle."""

    width_px: PositiveInt
    height_px: PositiveInt
    reach_m: PositiveFloat
    """Distance at which the laser meets the floor; nothing farther is lit."""
    range: RangeLaw
    lateral: LateralLaw
    vehicle: VehicleConfig = VehicleConfig()

    @model_validator(mode="after")
    def _widens(self) -> Self:
        """Refuse a lateral law whose lines of sight cross before the laser meets the floor."""
        height = (1e3 * self.reach_m / self.range.scale_mm) ** (1.0 / self.range.exponent) / 100.0
        scale = self.lateral.slope * self.height_px * height + self.lateral.offset
        if scale <= 0.0:
            raise ValueError(
                f"lateral: {scale:.3g} px/cm at reach_m = {self.reach_m:g}, want > 0; "
                "are slope and offset right?"
            )
        return self


THESIS = LineLaserCalibration(
    width_px=640,
    height_px=360,
    reach_m=1.9,
    range=RangeLaw(scale_mm=47366.0, exponent=-1.013),
    lateral=LateralLaw(slope=0.0447, offset=-1.4267),
)
"""The sensor of Somlyai (PhD thesis), eq. 2.44 and 2.45, and the farthest point it could measure."""


Degrees = Annotated[float, Field(ge=0.0, lt=360.0)]


class StripeConfig(Config):
    """Settings of the stripe detection (Somlyai, PhD thesis, §2.5.2)."""

    hue_from_deg: Degrees = 355.0
    hue_to_deg: Degrees = 10.0
    """Range of the laser's hues, from and to (figure 2.2); it may pass through 0."""
    saturation_threshold: Level = 64
    """Threshold of the saturation of pixels whose hue is used: grey has none; the thesis gives no
    threshold."""
    intensity_threshold: Level = 250
    """Threshold of the red channel (eq. 2.39; figure 2.3)."""
    weight_threshold: Level = 40
    """Threshold of 2R − G − B (eq. 2.41); the thesis gives none, and without one half of all grey noise is
    red."""
    edge_threshold: Level = 150
    """Threshold of the Laplacian of Gaussian (figure 2.5)."""
    edge_sigma_px: PositiveFloat = 1.5
    """Standard deviation of that Gaussian; the thesis gives none."""
    join_px: Annotated[int, Field(ge=0, le=100)] = 6
    """Pixels of a column with at most this many others between them are one stripe."""


class LineLaserMapConfig(Config):
    """The grids: the local one before the vehicle (Somlyai, PhD thesis, alg. 2), and the world's."""

    cell_m: PositiveFloat = 0.01
    """Edge of a cell of the local grid D[r, e]."""
    depth_cells: PositiveInt = 190
    """r: rows of the local grid."""
    width_cells: PositiveInt = 240
    """e: its columns."""
    floor_margin_m: NonNegativeFloat = 0.08
    """Points within this distance of the laser's reach are the floor."""
    resolution_m: PositiveFloat = 0.02
    """Edge of a cell of the world's grid."""
    hit_probability: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.7
    miss_probability: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.4
    clamp_min_probability: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.1192
    clamp_max_probability: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.971
    max_wheel_gap_s: PositiveFloat = 0.5
    """An image in a longer gap of the wheels' readings is left out of the map."""


class LineLaserConfig(Config):
    """All settings of ``mapper sensor line-laser``."""

    stripe: StripeConfig = StripeConfig()
    map: LineLaserMapConfig = LineLaserMapConfig()
    rate_hz: PositiveFloat | None = None
    """Images per second if neither file names nor a times.txt give stamps; None is 10."""


class LineLaserSynthConfig(Config):
    """A car with a line laser drives round a block in a room; the same configuration gives the same bytes."""

    seed: Annotated[int, Field(ge=0)] = 0
    rate_hz: PositiveFloat = 5.0
    duration_s: PositiveFloat | None = None
    """Length of the log; None is one round."""
    speed_mps: PositiveFloat = 0.3
    wheelbase_m: PositiveFloat = 0.26
    sensor_x_m: float = 0.2

    width_px: PositiveInt = 640
    height_px: PositiveInt = 360
    focal_px: PositiveFloat = 550.0
    reach_m: PositiveFloat = 1.9
    """Distance at which the laser meets the floor."""
    ambient: PositiveFloat = 0.55
    """Brightness of the room; from 1 on, white walls are as bright as a pixel can be."""
    lamps: NonNegativeFloat = 0.3
    """Lamps, windows and other bright things, per metre of wall."""
    red_things: NonNegativeFloat = 1.0
    """Red things per metre of wall."""
    dull_things: NonNegativeFloat = 0.3
    """Things that return no laser light, per metre of wall."""
    noise_levels: NonNegativeFloat = 3.0
