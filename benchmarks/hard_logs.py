"""The hard set: synthetic logs that are hard to track, as arguments of ``mapper synth``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

_SMALL = ("--set", "width_px=320", "--set", "height_px=240", "--set", "texture_px_per_m=128")
_LARGE = ("--set", "texture_px_per_m=128", "--set", "image_format=jpg")


def _set(*assignments: str) -> tuple[str, ...]:
    return tuple(word for assignment in assignments for word in ("--set", assignment))


@dataclass(frozen=True, slots=True)
class HardLog:
    """One log.

    Attributes:
        why: Difficulty of the log.
        arguments: Arguments of ``mapper synth`` besides the folder and the seed.
    """

    why: str
    arguments: Sequence[str]


def _camera(why: str, *assignments: str, scene: str = "flat", more: Sequence[str] = _SMALL) -> HardLog:
    return HardLog(why, ("--scene", scene, *more, *_set(*assignments)))


def _lidar(why: str, *assignments: str, scene: str) -> HardLog:
    return HardLog(why, ("--sensor", "lidar", "--scene", scene, *_set(*assignments)))


HARD_LOGS: Mapping[str, HardLog] = {
    "corridor": _camera(
        "22 m of corridor, 4.5 m wide, painted walls; most of what is seen lies 3 to 8 m off",
        "frame_rate_hz=10", "duration_s=24", scene="corridor", more=_LARGE,
    ),
    "corridor_uncalibrated": _camera(
        "the same with rolling shutter, late depth, lens and depth errors that no calibration mentions",
        "frame_rate_hz=15", "duration_s=16", scene="corridor", more=(*_LARGE, "--uncalibrated"),
    ),
    "corridor_pale": _camera(
        "a corridor 6 m wide, pale: hardly any contrast but on far doors and posters, exposures of 10 ms",
        "hall_width_m=6", "hall_clearance_m=2.7", "room_height_m=3.6", "furniture_per_room=0",
        "posters_per_room=6", "texture_contrast=0.15", "sensor.exposure_s=0.01", "speed_mps=1.1",
        "frame_rate_hz=15", "duration_s=14", scene="corridor", more=_LARGE,
    ),
    "hall": _camera(
        "hall of 15 by 13 m, painted walls 4 to 8 m off, few near things",
        "frame_rate_hz=10", scene="hall", more=_LARGE,
    ),
    "white_room": _camera(
        "nothing has texture: only the depth image shows anything",
        "frame_rate_hz=15", "duration_s=20", scene="white-room",
    ),
    "spin": _camera(
        "turns on the spot, up to 2.5 rad/s",
        "path=spin", "max_yaw_rate_rad_s=2.5", "duration_s=8",
    ),
    "blur": _camera(
        "exposures of 30 ms, walking at 1.1 m/s and turning at up to 1.8 rad/s",
        "frame_rate_hz=15", "duration_s=20", "sensor.exposure_s=0.03",
        "speed_mps=1.1", "max_yaw_rate_rad_s=1.8",
    ),
    "exposure_steps": _camera(
        "every 1.5 s the image is up to 4 times as bright, saturated, or as dark",
        "frame_rate_hz=15", "duration_s=20", "disturbances.gain_step_s=1.5", "disturbances.gain_factor=4",
    ),
    "gap": _camera(
        "all frames between 7 and 9 s are missing",
        "frame_rate_hz=15", "duration_s=20", "disturbances.gap_start_s=7", "disturbances.gap_duration_s=2",
    ),
    "frozen": _camera(
        "between 7 and 10 s one frame is repeated while the camera walks on",
        "frame_rate_hz=15", "duration_s=20",
        "disturbances.freeze_start_s=7", "disturbances.freeze_duration_s=3",
    ),
    "hand": _camera(
        "between 7 and 10 s a hand 0.45 m before the lens, with depth, covers three quarters of the image",
        "frame_rate_hz=15", "duration_s=20", "disturbances.hand_start_s=7", "disturbances.hand_duration_s=3",
    ),
    "frozen_lap": _camera(
        "one frame is repeated for 3 s; the walk goes on round the flat to where it began",
        "frame_rate_hz=10", "overlap_m=4",
        "disturbances.freeze_start_s=7", "disturbances.freeze_duration_s=3",
    ),
    "hand_lap": _camera(
        "a hand covers the lens for 3 s; the walk goes on round the flat to where it began",
        "frame_rate_hz=10", "overlap_m=4",
        "disturbances.hand_start_s=7", "disturbances.hand_duration_s=3",
    ),
    "kidnapped": _camera(
        "from 6 to 12 s the lens is covered and the camera is carried to another room; it comes back",
        "frame_rate_hz=10", "blackout_start_s=6", "blackout_duration_s=6", "overlap_m=6",
    ),
    "twin_wheels": _camera(
        "two rooms alike to the last thing, 10 m apart, with exact wheels",
        "frame_rate_hz=8", "wheels.path_sigma=0", "wheels.turn_sigma=0", "wheels.heading_rad_per_sqrt_m=0",
        scene="twin-rooms", more=(*_SMALL, "--wheels"),
    ),
    "twin": _camera("the same two rooms, by hand and without wheels", "frame_rate_hz=8", scene="twin-rooms"),
    "people": _camera(
        "12 people cross the view, within two metres, in a hall with bare walls",
        "frame_rate_hz=15", "people=12", "duration_s=18", "hall_length_m=9", "hall_width_m=8",
        "hall_clearance_m=2.6", "posters_per_room=20", scene="hall",
    ),
    "people_few": _camera(
        "three people cross the view in the flat", "frame_rate_hz=15", "people=3", "duration_s=18",
    ),
    "rate_2hz": _camera(
        "two images a second, by hand", "frame_rate_hz=2", "max_yaw_rate_rad_s=0.6", more=_LARGE,
    ),
    "rate_1_5hz": _camera(
        "1.5 images a second, by hand",
        "frame_rate_hz=1.5", "speed_mps=0.5", "max_yaw_rate_rad_s=0.45", more=_LARGE,
    ),
    "every_10th": _camera(
        "every 10th frame of 30 Hz", "frame_rate_hz=3", "max_yaw_rate_rad_s=0.9", more=_LARGE,
    ),
    "uncalibrated": _camera(
        "rolling shutter, late depth, lens and depth errors that no calibration mentions",
        "frame_rate_hz=30", "duration_s=10", "path=desk", more=(*_LARGE, "--uncalibrated"),
    ),
    "uncalibrated_loop": _camera(
        "the same sensor on a walk through the flat",
        "frame_rate_hz=15", more=(*_SMALL, "--uncalibrated"),
    ),
    "desk_fast": _camera(
        "that sensor before a desk, at 0.9 m/s to and fro",
        "frame_rate_hz=30", "duration_s=9", "path=desk", "shake_m=0.25", "shake_rad=0.2",
        more=(*_SMALL, "--uncalibrated"),
    ),
    "white_room_uncalibrated": _camera(
        "that sensor where nothing has texture: its distorted depth alone shows anything",
        "frame_rate_hz=15", "duration_s=20", scene="white-room", more=(*_SMALL, "--uncalibrated"),
    ),
    "lidar_tunnel": _lidar(
        "a smooth tunnel of 100 m; beams reach 30 m, so nothing tells the way along its axis",
        "sensor.rings=16", "sensor.max_range_m=30", "duration_s=30", scene="tunnel",
    ),
    "lidar_field": _lidar(
        "open ground with a few trees and bushes", "sensor.rings=16", "duration_s=30", scene="field",
    ),
    "lidar_staircase": _lidar(
        "three storeys of stairs, alike, by hand", "sensor.rings=16", scene="staircase",
    ),
    "lidar_2hz": _lidar(
        "two scans a second in rooms, looking around fast",
        "sensor.rings=16", "rate_hz=2", "yaw_swing_rad=1.2", "sensor.motion_distortion=false", scene="flat",
    ),
    "lidar_2hz_fast": _lidar(
        "the same, walking faster, looking around by a right angle and tilting",
        "sensor.rings=16", "rate_hz=2", "yaw_swing_rad=1.57", "tilt_rad=0.35", "speed_mps=1.2", "laps=2",
        "sensor.motion_distortion=false", scene="flat",
    ),
    "lidar_swept": _lidar(
        "the same with sweeps of 0.1 s, distorted by turning at rates that change between two scans",
        "sensor.rings=16", "rate_hz=2", "yaw_swing_rad=1.57", "tilt_rad=0.35", "speed_mps=1.2",
        scene="flat",
    ),
    "lidar_roll": _lidar(
        "a street, the sensor rolling by 30 degrees", "sensor.rings=32", "tilt_rad=0.52", "duration_s=25",
        scene="street",
    ),
}  # fmt: skip
"""Hard logs by the name of the log's folder."""
