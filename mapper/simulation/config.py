"""Settings of synthetic logs: the world, the path through it, and the camera or LiDAR."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from mapper.core.config import Config, Ratio
from mapper.simulation.gnss_config import SynthGnssConfig


class SensorConfig(Config):
    """A Kinect v1: structured light with a 7.5 cm baseline (Khoshelham & Elberink 2012)."""

    axial_noise_ratio: NonNegativeFloat = 1.0
    """Multiplies σ_z = 1.2 mm + 1.9 mm/m² · (z − 0.4 m)² (Nguyen et al. 2012, eq. 3); 0 is exact depth."""
    disparity_noise_px: NonNegativeFloat = 0.0
    """Standard deviation of the disparity, in pixels at 640 px: σ_z is z² times this over 43.5 m px, as of a
    stereo camera, for which ``axial_noise_ratio`` is 0."""
    lateral_noise_px: NonNegativeFloat = 0.4
    """Standard deviation of the pixel position at which a depth was measured."""
    disparity_step_px: NonNegativeFloat = 0.125
    """Disparity is reported in these steps; 0 does not quantise."""
    dropout_ratio: Ratio = 1.0
    """Multiplies the chances of losing depth at shadows, edges and grazing angles, and at random."""
    min_depth_m: NonNegativeFloat = 0.4
    fade_depth_m: PositiveFloat = 5.0
    """From here to ``max_depth_m`` fewer and fewer pixels have depth."""
    max_depth_m: PositiveFloat = 8.0
    image_noise_levels: NonNegativeFloat = 2.0
    """Standard deviation of the image noise in grey levels."""
    exposure_s: NonNegativeFloat = 0.0
    """Motion during this time blurs the image; 0 is a perfect shutter."""
    readout_s: NonNegativeFloat = 0.0
    """Rolling shutter: from the first row of an image to its last; the stamp is that of the middle row."""
    depth_delay_s: float = 0.0
    """Delay of the depth measurement after the colour image."""
    radial_k1: float = 0.0
    radial_k2: float = 0.0
    """Distortion of the lens (Brown 1971) that is missing from the log's calibration."""
    depth_scale: PositiveFloat = 1.0
    """Factor on every depth, like that of wrong units."""
    disparity_warp_px: NonNegativeFloat = 0.0
    """Standard deviation over the image of a smooth error of the disparity, the same in all frames (Herrera
    et al. 2012), in pixels at 640 px; depth is wrong by its square times this over 43.5 m px."""


class SynthWheelsConfig(Config):
    """Wheels that carry the sensor, and how wrongly they count."""

    rate_hz: PositiveFloat = 50.0
    """Poses per second."""
    path_sigma: NonNegativeFloat = 0.01
    """Standard deviation, over logs, of the relative error of the wheels' size."""
    turn_sigma: NonNegativeFloat = 0.01
    """Likewise of the distance between the wheels, and so of turns."""
    heading_rad_per_sqrt_m: NonNegativeFloat = 0.005
    """Standard deviation of the heading after a metre of uneven floor; it grows with the square root of the
    path."""


class SynthImuConfig(Config):
    """Inertial measurement unit beside the sensor; by default one of a hand-held LiDAR."""

    rate_hz: PositiveFloat = 200.0
    gyroscope_noise_radps: NonNegativeFloat = 0.003
    """Standard deviation of each reading."""
    bias_radps: NonNegativeFloat = 0.01
    """Standard deviation, over logs, of the gyroscope's bias at the start."""
    bias_walk_radps_per_sqrt_s: NonNegativeFloat = 2e-4
    accelerometer_noise_mps2: NonNegativeFloat = 0.05
    accelerometer_bias_mps2: NonNegativeFloat = 0.05
    """Standard deviation, over logs, of the accelerometer's bias."""
    mounting_rad: tuple[float, float, float] = (0.1, -0.2, 1.5)
    """Rotation vector of the unit in the body."""
    offset_s: NonNegativeFloat = 0.007
    """Time by which the unit's clock is ahead of the sensor's."""
    in_g: bool = False
    """Accelerations are in units of gravity, as Livox's driver writes them."""


class DisturbanceConfig(Config):
    """Disturbances of a recording; by default there are none."""

    gap_start_s: NonNegativeFloat = 0.0
    gap_duration_s: NonNegativeFloat = 0.0
    """Duration for which all frames are missing."""
    freeze_start_s: NonNegativeFloat = 0.0
    freeze_duration_s: NonNegativeFloat = 0.0
    """Duration for which the previous frame is repeated, image and depth, while the camera moves on."""
    hand_start_s: NonNegativeFloat = 0.0
    hand_duration_s: NonNegativeFloat = 0.0
    """Duration for which a hand is held in front of the lens and moves with the camera."""
    hand_share: Annotated[float, Field(gt=0.0, le=1.0)] = 0.75
    """Approximate share of the image that it covers."""
    hand_distance_m: PositiveFloat = 0.45
    """Below the sensor's ``min_depth_m`` it has no depth."""
    gain_step_s: NonNegativeFloat = 0.0
    """The image's brightness jumps at every multiple of this time; 0 never."""
    gain_factor: Annotated[float, Field(ge=1.0)] = 3.0
    """Largest factor by which the image is alternately brighter and darker; values above white are
    clipped."""


class SynthConfig(Config):
    """One synthetic log: the same configuration gives the same bytes."""

    seed: NonNegativeInt = 0
    day: NonNegativeInt = 0
    """Another day in the same rooms: other light, chairs, tables and cartons stand elsewhere, and the walker
    looks elsewhere on the way."""

    scene: Literal["flat", "hall", "twin-rooms"] = "flat"
    """"flat": a ring of rooms; "hall": one hall or corridor with closed doors; "twin-rooms": two rooms that
    are alike to the last thing, 10 m apart on a corridor."""
    hall_length_m: Annotated[float, Field(ge=4.0)] = 15.0
    hall_width_m: Annotated[float, Field(ge=2.0)] = 13.0
    hall_clearance_m: Annotated[float, Field(ge=0.6)] = 4.5
    """Distance from the walls of a hall to the path, the camera's smallest distance from them."""
    rooms: Annotated[int, Field(ge=4, multiple_of=2)] = 4
    """Rooms of the flat, in two rows; doors join them to one ring."""
    room_size_m: Annotated[float, Field(ge=3.6, le=60.0)] = 4.4
    """Mean side of a room, wall to wall."""
    room_height_m: Annotated[float, Field(ge=2.3)] = 2.6
    furniture_per_room: NonNegativeInt = 9
    posters_per_room: NonNegativeInt = 8
    moving_boxes: NonNegativeInt = 0
    """Number of boxes that move around the flat all the time."""
    people: NonNegativeInt = 0
    """People who each cross the view once, within two metres of the camera."""
    people_stand_s: NonNegativeFloat = 0.0
    """How long each of them stands still in the middle of the view before walking on."""
    texture_contrast: Ratio = 1.0
    """Contrast of all textures and of the light; with 0 everything is uniformly white, and only depth
    varies."""
    texture_px_per_m: PositiveInt = 256
    """Detail of walls and floors; smaller is faster to make and enough for small images."""

    path: Literal["loop", "desk", "spin", "wall"] = "loop"
    """"loop": walk through every room; "desk": small motions before a desk; "spin": turn fast on the spot;
    "wall": stand before a wall, looking straight at it."""
    wall_distance_m: Annotated[float, Field(gt=0.0, le=50.0)] = 1.5
    """Distance from the camera to that wall."""
    laps: PositiveFloat = 1.0
    """Rounds of the loop."""
    overlap_m: NonNegativeFloat = 1.0
    """Length by which the loop continues past its start, so that its ends see the same."""
    duration_s: PositiveFloat | None = None
    """Length of the log; None is as long as the laps take, or 20 s for the other paths."""
    frame_rate_hz: PositiveFloat = 30.0
    speed_mps: PositiveFloat = 0.9
    """Walking speed on the loop; sharp turns are slower."""
    max_yaw_rate_rad_s: PositiveFloat = 1.2
    """The walker's largest turning rate; the shake is added."""
    shake_m: NonNegativeFloat = 0.015
    """Amplitude of the hand's shake along each axis."""
    shake_rad: NonNegativeFloat = 0.02
    wheels: SynthWheelsConfig | None = None
    """The camera is on wheels with odometry, and neither shakes nor nods; None is a walker's hand."""
    imu: SynthImuConfig | None = None
    """Inertial readings of the log; None is none."""

    width_px: PositiveInt = 640
    height_px: PositiveInt = 480
    horizontal_view_rad: Annotated[float, Field(gt=0.1, lt=2.6)] = 1.0947
    """Angle of view across the image; the default is a focal length of 525 px at 640 px."""
    sensor: SensorConfig = SensorConfig()

    drop_ratio: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Share of frames that are missing from the log."""
    blackout_start_s: NonNegativeFloat = 0.0
    blackout_duration_s: NonNegativeFloat = 0.0
    """Duration for which the lens is covered: black images without depth; 0 never."""
    image_format: Literal["png", "jpg"] = "png"
    """How colour images are stored; "jpg" is a fifth of the size and not exact."""
    disturbances: DisturbanceConfig = DisturbanceConfig()

    @model_validator(mode="after")
    def _wheels_stay_on_the_floor(self) -> Self:
        if self.wheels is not None and self.path == "desk":
            raise ValueError("path desk moves up and down, which wheels do not; want loop or spin")
        return self

    @model_validator(mode="after")
    def _hall_has_room_for_the_way(self) -> Self:
        narrow_m = min(self.hall_length_m, self.hall_width_m)
        if self.scene == "hall" and 2.0 * self.hall_clearance_m + 0.4 > narrow_m:
            raise ValueError(
                f"hall_clearance_m {self.hall_clearance_m:g}: leaves no way through a {narrow_m:g} m; "
                f"want at most {narrow_m / 2.0 - 0.2:.2f}"
            )
        if self.scene != "flat" and self.path == "desk":
            raise ValueError(f"path desk: scene {self.scene} has no desk; want loop, spin or wall")
        return self


CAMERA_SCENES: Mapping[str, SynthConfig] = {
    "flat": SynthConfig(),
    "corridor": SynthConfig(
        scene="hall",
        hall_length_m=22.0,
        hall_width_m=4.5,
        hall_clearance_m=1.8,
        room_height_m=3.0,
        furniture_per_room=3,
        posters_per_room=12,
    ),
    "hall": SynthConfig(scene="hall", room_height_m=4.5, furniture_per_room=3, posters_per_room=12),
    "white-room": SynthConfig(texture_contrast=0.0, posters_per_room=0),
    "twin-rooms": SynthConfig(scene="twin-rooms"),
}
"""Settings with which ``mapper synth`` begins, by scene of a camera."""

MOVING_INDOORS: Mapping[str, int] = {"people": 4, "moving_boxes": 1}
MOVING_OUTDOORS: Mapping[str, int] = {"cars": 10, "cyclists": 6, "pedestrians": 16}
PEDESTRIANS: Mapping[str, int] = {"pedestrians": 6}
"""Settings of what moves; pedestrians where there is no road."""

UNCALIBRATED: Mapping[str, float] = {
    "exposure_s": 0.012,
    "readout_s": 0.033,
    "depth_delay_s": 0.02,
    "radial_k1": 0.05,
    "radial_k2": -0.1,
    "depth_scale": 1.01,
    "disparity_warp_px": 0.3,
}
"""Settings of a sensor whose errors a factory calibration leaves, as those of a real Kinect."""


class LidarSensorConfig(Config):
    """A multi-beam LiDAR; by default the rings of a Velodyne HDL-64E."""

    pattern: Literal["rings", "rosette", "zigzag"] = "rings"
    """"rosette": two rotating prisms swing the beams within 70° ahead, along curves that never repeat (Livox
    Avia: 6 rings, 4000 azimuth steps); "zigzag": the beams turn, and go up and down (Livox Mid-360: 4 rings,
    5000 azimuth steps, -0.1 to 0.9 rad)."""
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
    day: NonNegativeInt = 0
    """Another day in the same place: most parked cars, bicycles and bins are gone or stand elsewhere, and the
    sensor keeps to another line of its lane."""

    scene: Literal["street", "courtyard", "field", "tunnel", "staircase", "flat"] = "street"
    """"street": round a block between facades; "courtyard": a yard with few things in it; "field": open
    ground with fewer; "tunnel": a smooth tube, there and back; "staircase": up, a storey a lap; "flat": the
    rooms of the synthetic camera."""
    loop_m: Annotated[float, Field(ge=30.0)] = 300.0
    """Length of the closed route, along which the scene is built; staircase and flat have their own."""
    slope_rad: Annotated[float, Field(ge=0.0, lt=0.3)] = 0.01
    """Mean slope of the ground."""
    undulation_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1
    """Largest height of the ground's waves above its mean slope."""

    cars: NonNegativeInt = 0
    """Cars that drive along the route: some ahead of the sensor, the others towards it."""
    cyclists: NonNegativeInt = 0
    pedestrians: NonNegativeInt = 0
    """People who walk along the route beside it, and stand still now and then."""

    laps: PositiveFloat = 1.0
    overlap_m: NonNegativeFloat = 15.0
    """Length by which the path continues past its start, so that its ends see the same."""
    duration_s: PositiveFloat | None = None
    """Length of the log; None is as long as the laps take."""
    rate_hz: PositiveFloat = 10.0
    """Scans recorded per second."""
    speed_mps: PositiveFloat = 5.0
    mount_height_m: PositiveFloat = 1.7
    """Height of the sensor above the ground."""
    tilt_rad: Annotated[float, Field(ge=0.0, le=0.6)] = 0.0
    """Angle by which the sensor's up axis swings from the ground's normal, in changing directions."""
    yaw_swing_rad: Annotated[float, Field(ge=0.0, le=1.6)] = 0.0
    """Angle by which the sensor turns to either side of the direction of travel."""
    wheels: SynthWheelsConfig | None = None
    """What is read of the vehicle's wheels."""
    imu: SynthImuConfig | None = None
    """Inertial readings of the log; None is none."""
    gnss: SynthGnssConfig | None = None
    """Fixes of a GNSS receiver; None is none."""

    sensor: LidarSensorConfig = LidarSensorConfig()

    @model_validator(mode="after")
    def _wheels_climb_no_stairs(self) -> Self:
        if self.wheels is not None and self.scene == "staircase":
            raise ValueError("wheels: do not climb a staircase; choose another scene")
        return self

    @model_validator(mode="after")
    def _traffic_has_room(self) -> Self:
        road, roaming = self.cars + self.cyclists, self.pedestrians
        if (road and self.scene != "street") or (roaming and self.scene in ("tunnel", "staircase", "flat")):
            raise ValueError(
                f"scene {self.scene}: has no room for what moves; want cars and cyclists in street alone, "
                "pedestrians in street, courtyard or field"
            )
        return self


_LATER = {
    SynthConfig: {
        *("moving_boxes", "wheels", "imu", "scene", "hall_length_m", "hall_width_m", "hall_clearance_m"),
        *("people", "people_stand_s", "texture_contrast", "disturbances", "day"),
    },
    SensorConfig: {
        *("readout_s", "depth_delay_s", "radial_k1", "radial_k2", "depth_scale", "disparity_warp_px"),
    },
    LidarSynthConfig: {"wheels", "imu", "gnss", "cars", "cyclists", "pedestrians", "day"},
    LidarSensorConfig: set(),
}
"""Settings that came after the first logs."""


def set_or_first(config: SynthConfig | LidarSynthConfig, *, exclude: set[str]) -> dict[str, Any]:
    """Return the settings, without later ones at their defaults: so older logs' files keep their bytes."""
    settings = config.model_dump(mode="json", exclude=exclude)
    for part, into in ((config, settings), (config.sensor, settings["sensor"])):
        for name in _LATER[type(part)]:
            if getattr(part, name) == type(part).model_fields[name].default:
                into.pop(name, None)
    return settings


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

_PUCK = LidarSensorConfig(
    rings=16, lowest_ring_rad=-0.2618, highest_ring_rad=0.2618, azimuth_steps=900, min_range_m=0.3
)
"""The rings of a Velodyne VLP-16."""

LIDAR_SCENES: Mapping[str, LidarSynthConfig] = {
    "street": STREET,
    "courtyard": COURTYARD,
    "field": LidarSynthConfig(
        scene="field", loop_m=120.0, undulation_m=0.2, speed_mps=3.0, mount_height_m=1.4, sensor=_PUCK
    ),
    "tunnel": LidarSynthConfig(
        scene="tunnel", loop_m=200.0, slope_rad=0.0, undulation_m=0.0, speed_mps=3.0, sensor=_PUCK
    ),
    "staircase": LidarSynthConfig(
        scene="staircase",
        slope_rad=0.0,
        undulation_m=0.0,
        laps=3.0,
        overlap_m=0.0,
        rate_hz=5.0,
        speed_mps=0.5,
        mount_height_m=1.3,
        tilt_rad=0.15,
        yaw_swing_rad=0.3,
        sensor=_PUCK,
    ),
    "flat": LidarSynthConfig(
        scene="flat",
        slope_rad=0.0,
        undulation_m=0.0,
        overlap_m=2.0,
        rate_hz=5.0,
        speed_mps=0.8,
        mount_height_m=1.3,
        tilt_rad=0.1,
        sensor=_PUCK,
    ),
}
"""Settings with which ``mapper synth`` begins, by scene of a LiDAR."""
