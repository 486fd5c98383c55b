"""The synthetic flat, the walk through it, and the camera that records it."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.config.base import Config

Ratio = Annotated[float, Field(ge=0.0, le=1.0)]


class SensorConfig(Config):
    """A Kinect v1: structured light with a 7.5 cm baseline (Khoshelham & Elberink 2012)."""

    axial_noise_ratio: NonNegativeFloat = 1.0
    """Multiplies σ_z = 1.2 mm + 1.9 mm/m² · (z − 0.4 m)² (Nguyen et al. 2012, eq. 3); 0 is exact depth."""
    lateral_noise_px: NonNegativeFloat = 0.4
    """Standard deviation of where in the image a depth really was measured."""
    disparity_step_px: NonNegativeFloat = 0.125
    """Disparity is reported in these steps; 0 does not quantise."""
    dropout_ratio: Ratio = 1.0
    """Multiplies the chances of losing depth at shadows, edges and grazing angles, and at random."""
    min_depth_m: NonNegativeFloat = 0.4
    fade_depth_m: PositiveFloat = 5.0
    """From here to ``max_depth_m`` ever fewer pixels return."""
    max_depth_m: PositiveFloat = 8.0
    image_noise_levels: NonNegativeFloat = 2.0
    """Standard deviation of the image noise in grey levels."""
    exposure_s: NonNegativeFloat = 0.0
    """Motion during this time blurs the image; 0 is a perfect shutter."""


class SynthConfig(Config):
    """One synthetic log: the same configuration gives the same bytes."""

    seed: NonNegativeInt = 0

    rooms: Annotated[int, Field(ge=4, multiple_of=2)] = 4
    """Rooms of the flat, in two rows; doors join them to one ring."""
    room_size_m: Annotated[float, Field(ge=3.6)] = 4.4
    """Mean side of a room, wall to wall."""
    room_height_m: Annotated[float, Field(ge=2.3)] = 2.6
    furniture_per_room: NonNegativeInt = 9
    posters_per_room: NonNegativeInt = 8
    moving_boxes: NonNegativeInt = 0
    """Boxes that travel round the flat all the time."""
    texture_px_per_m: PositiveInt = 256
    """Detail of walls and floors; smaller is faster to make and enough for small images."""

    path: Literal["loop", "desk", "spin"] = "loop"
    """"loop": walk through every room; "desk": small motions before a desk; "spin": turn fast on the spot."""
    laps: PositiveFloat = 1.0
    """Rounds of the loop."""
    overlap_m: NonNegativeFloat = 1.0
    """How far the loop goes on past its start, so that its ends see the same."""
    duration_s: PositiveFloat | None = None
    """Length of the log; None is as long as the laps take, or 20 s for the other paths."""
    frame_rate_hz: PositiveFloat = 30.0
    speed_mps: PositiveFloat = 0.9
    """Walking speed on the loop; sharp turns are slower."""
    max_yaw_rate_rad_s: PositiveFloat = 1.2
    """The walker's fastest turn; the shake comes on top."""
    shake_m: NonNegativeFloat = 0.015
    """Amplitude of the hand's unsteadiness along each axis."""
    shake_rad: NonNegativeFloat = 0.02

    width_px: PositiveInt = 640
    height_px: PositiveInt = 480
    horizontal_view_rad: Annotated[float, Field(gt=0.1, lt=2.6)] = 1.0947
    """Angle of view across the image; the default is a focal length of 525 px at 640 px."""
    sensor: SensorConfig = SensorConfig()

    drop_ratio: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Share of frames that are missing from the log."""
    blackout_start_s: NonNegativeFloat = 0.0
    blackout_duration_s: NonNegativeFloat = 0.0
    """For this long the lens is covered: black images without depth; 0 never."""
    image_format: Literal["png", "jpg"] = "png"
    """How colour images are stored; "jpg" is a fifth of the size and not exact."""


IDEAL_SENSOR = SensorConfig(
    axial_noise_ratio=0.0,
    lateral_noise_px=0.0,
    disparity_step_px=0.0,
    dropout_ratio=0.0,
    min_depth_m=0.0,
    fade_depth_m=1e3,
    max_depth_m=1e3,
    image_noise_levels=0.0,
)
"""Exact depth and noise-free images."""
