"""Settings of synthetic logs: the world, the path through it, and the camera or LiDAR."""

from collections.abc import Mapping
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from mapper.core.config import Config, Ratio


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


class SynthWheelsConfig(Config):
    """Wheels that carry the sensor, and how wrongly they count."""

    rate_hz: PositiveFloat = 50.0
    """Poses per second."""
    path_sigma: NonNegativeFloat = 0.01
    """Standard deviation, over logs, of the share by which wheels are larger than they are taken to be."""
    turn_sigma: NonNegativeFloat = 0.01
    """The same of the distance between them, and so of turns."""
    heading_rad_per_sqrt_m: NonNegativeFloat = 0.005
    """Standard deviation of the heading after a metre of uneven floor; it grows with the way's root."""


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

    path: Literal["loop", "desk", "spin", "wall"] = "loop"
    """"loop": walk through every room; "desk": small motions before a desk; "spin": turn fast on the spot;
    "wall": stand before a wall, looking straight at it."""
    wall_distance_m: PositiveFloat = 1.5
    """From the camera to that wall."""
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
    wheels: SynthWheelsConfig | None = None
    """Wheels carry the camera, which then neither shakes nor nods, and are read; None is a walker's hand."""

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

    @model_validator(mode="after")
    def _wheels_stay_on_the_floor(self) -> Self:
        if self.wheels is not None and self.path == "desk":
            raise ValueError("path desk moves up and down, which wheels do not; want loop or spin")
        return self


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


class LidarSensorConfig(Config):
    """A spinning multi-beam LiDAR; by default the rings of a Velodyne HDL-64E."""

    rings: PositiveInt = 64
    lowest_ring_rad: Annotated[float, Field(gt=-1.5, lt=1.5)] = -0.4346
    highest_ring_rad: Annotated[float, Field(gt=-1.5, lt=1.5)] = 0.0349
    """Elevation of the outermost rings; the others lie evenly between."""
    azimuth_steps: PositiveInt = 900
    sweep_s: PositiveFloat = 0.1
    """Time of one turn, whatever the log's scan rate."""
    min_range_m: NonNegativeFloat = 1.0
    max_range_m: PositiveFloat = 80.0
    range_noise_m: NonNegativeFloat = 0.02
    """Standard deviation along the ray."""
    dropout_ratio: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.02
    """Share of returns that are lost at random."""
    motion_distortion: bool = True
    """Whether the sensor moves while it turns; the points then have times. False freezes it at the stamp."""

    @model_validator(mode="after")
    def _rings_rise(self) -> Self:
        if self.highest_ring_rad < self.lowest_ring_rad:
            raise ValueError(
                f"highest_ring_rad = {self.highest_ring_rad} lies below "
                f"lowest_ring_rad = {self.lowest_ring_rad}; swap them"
            )
        return self


class LidarSynthConfig(Config):
    """One synthetic LiDAR log: the same configuration gives the same points."""

    seed: NonNegativeInt = 0

    scene: Literal["street", "courtyard"] = "street"
    """"street": round a block between facades; "courtyard": a yard with few things in it."""
    loop_m: Annotated[float, Field(ge=30.0)] = 300.0
    """Length of the closed route, along which the scene is built."""
    slope_rad: Annotated[float, Field(ge=0.0, lt=0.3)] = 0.01
    """Mean slope of the ground."""
    undulation_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1
    """Largest height of the ground's waves above its mean slope."""

    laps: PositiveFloat = 1.0
    overlap_m: NonNegativeFloat = 15.0
    """How far the way goes on past its start, so that its ends see the same."""
    duration_s: PositiveFloat | None = None
    """Length of the log; None is as long as the laps take."""
    rate_hz: PositiveFloat = 10.0
    """Scans recorded per second."""
    speed_mps: PositiveFloat = 5.0
    mount_height_m: PositiveFloat = 1.7
    """Height of the sensor above the ground."""
    tilt_rad: Annotated[float, Field(ge=0.0, le=0.6)] = 0.0
    """The sensor's up swings this far from the ground's normal, in changing directions."""
    yaw_swing_rad: Annotated[float, Field(ge=0.0, le=1.6)] = 0.0
    """The sensor turns this far to either side of the direction of travel."""
    wheels: SynthWheelsConfig | None = None
    """What is read of the vehicle's wheels."""

    sensor: LidarSensorConfig = LidarSensorConfig()


STREET = LidarSynthConfig()
"""A car's LiDAR on its way round a block."""

COURTYARD = LidarSynthConfig(
    scene="courtyard",
    loop_m=60.0,
    overlap_m=5.0,
    rate_hz=2.0,
    speed_mps=1.2,
    tilt_rad=0.52,
    yaw_swing_rad=0.8,
    sensor=LidarSensorConfig(
        rings=32, lowest_ring_rad=-0.5236, highest_ring_rad=0.2618, motion_distortion=False
    ),
)
"""A LiDAR carried by hand, strongly tilting and turning, past few things.

Its sweeps are free of motion: with poses half a second apart, the turning within a sweep is unknown.
"""

SCENES: Mapping[str, LidarSynthConfig] = {"street": STREET, "courtyard": COURTYARD}
"""Where ``mapper synth`` begins."""

IDEAL_LIDAR = LidarSensorConfig(range_noise_m=0.0, dropout_ratio=0.0, min_range_m=0.0)
"""Exact ranges."""
