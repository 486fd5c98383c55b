"""``mapper synth``: a synthetic log with exact truth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.options import refuse_with, settings_of
from mapper.core.errors import ConfigError
from mapper.runtime.result_paths import LOGS, place_of

Settings = TypeVar("Settings")

SensorKind = Literal["rgbd", "lidar", "line-laser"]
SceneName = Literal[
    "flat",
    "corridor",
    "hall",
    "white-room",
    "twin-rooms",
    "street",
    "courtyard",
    "field",
    "tunnel",
    "staircase",
]

_NOT_OF: Mapping[SensorKind, tuple[str, ...]] = {
    "rgbd": ("--rings", "--gnss"),
    "lidar": ("--path", "--rooms", "--plane-at", "--uncalibrated"),
    "line-laser": (
        "--path",
        "--rooms",
        "--plane-at",
        "--scene",
        "--rings",
        "--wheels",
        "--imu",
        "--gnss",
        "--moving",
        "--uncalibrated",
    ),
}
"""Options that have no meaning for a sensor."""

_LEAST_NOISE = 1e-6
"""Factors on noise below it are 0: single precision holds no smaller steps of disparity."""


def synth(
    out: Annotated[
        Path | None,
        typer.Argument(
            metavar="[OUT]", help="Log folder to create.  [default: logs/SCENE, or with a number]"
        ),
    ] = None,
    sensor: Annotated[
        SensorKind, typer.Option(help="A camera in a flat, a LiDAR outdoors, or a line laser on a car.")
    ] = "rgbd",
    seconds: Annotated[float | None, typer.Option(help="Length of the log.")] = None,
    path: Annotated[str | None, typer.Option(help="rgbd: loop, desk, spin or wall.")] = None,
    rooms: Annotated[int | None, typer.Option(help="rgbd: rooms of the flat, an even number from 4.")] = None,
    plane_at: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            max=50.0,
            help="rgbd: stand still at this distance from a bare wall, 50 at most.",
        ),
    ] = None,
    scene: Annotated[
        SceneName | None,
        typer.Option(
            help="rgbd: flat, corridor, hall, white-room or twin-rooms; "
            "lidar: street, courtyard, field, tunnel, staircase or flat."
        ),
    ] = None,
    rings: Annotated[int | None, typer.Option(help="lidar: number of beams, one above the other.")] = None,
    wheels: Annotated[
        bool, typer.Option("--wheels", help="The sensor is on wheels; wheels.txt has their odometry.")
    ] = False,
    imu: Annotated[
        bool, typer.Option("--imu", help="imu.csv has the readings of an inertial measurement unit.")
    ] = False,
    gnss: Annotated[
        bool, typer.Option("--gnss", help="lidar: gnss.txt has the fixes of a GNSS receiver.")
    ] = False,
    moving: Annotated[
        bool,
        typer.Option(
            "--moving", help="rgbd: people and boxes cross the view; lidar: cars, cyclists and pedestrians."
        ),
    ] = False,
    noise: Annotated[float | None, typer.Option(help="Factor on the sensor's noise; 0 is exact.")] = None,
    uncalibrated: Annotated[
        bool,
        typer.Option(
            "--uncalibrated",
            help="rgbd: rolling shutter, late depth, lens and depth errors that are not in the calibration.",
        ),
    ] = False,
    seed: Annotated[int | None, typer.Option(help="Another scene and another path through it.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change any setting of the scene or sensor."),
    ] = None,
    *,
    output: Output,
) -> Answer:
    """Ray-cast a walk through rooms, or a LiDAR's path through streets or stairs, as a log with exact truth.

    Example: mapper synth logs/spin --path spin --seconds 10 --set sensor.exposure_s=0.01, or: mapper synth
    logs/yard --sensor lidar --scene courtyard --rings 16
    """
    options = {
        "--path": path,
        "--rooms": rooms,
        "--plane-at": plane_at,
        "--scene": scene,
        "--rings": rings,
        "--wheels": wheels,
        "--imu": imu,
        "--gnss": gnss,
        "--moving": moving,
        "--uncalibrated": uncalibrated,
    }
    refuse_with(f"--sensor {sensor}", {name: options[name] for name in _NOT_OF[sensor]})
    given: dict[str, object] = {"duration_s": seconds, "seed": seed}
    if sensor == "line-laser":
        return _line_laser(place_of(out, LOGS / sensor), given, noise, set_, output)
    if plane_at is not None:
        refuse_with("--plane-at", {"--path": path, "--scene": scene})
    if sensor == "rgbd":
        name, kind, write = scene or "flat", "TUM", _write_camera_log
        given |= {"path": path, "rooms": rooms} | _at_wall(plane_at) | _camera_noise(noise)
    else:
        name, kind, write = scene or "street", "KITTI", _write_lidar_log
        given |= {"sensor.rings": rings} | _lidar_noise(noise)
    out = place_of(out, LOGS / name)
    write(out, name, options, settings_of(given, set_), output)
    return Answer({"path": out, "format": kind}, f"{out}: a {kind} log; map it with mapper build {out}")


def _write_camera_log(
    out: Path, name: SceneName, options: Mapping[str, object], settings: dict[str, object], output: Output
) -> None:
    from mapper.config.loading import overridden
    from mapper.simulation import write_tum_log
    from mapper.simulation.config import (
        CAMERA_SCENES,
        MOVING_INDOORS,
        UNCALIBRATED,
        SynthImuConfig,
        SynthWheelsConfig,
    )

    start = _scene(CAMERA_SCENES, name, "rgbd")
    if start.scene != "flat":
        refuse_with(f"--scene {name}", {"--rooms": options["--rooms"]})
    changed: dict[str, object] = dict(MOVING_INDOORS) if options["--moving"] else {}
    if options["--wheels"]:
        changed["wheels"] = SynthWheelsConfig()
    if options["--imu"]:
        changed["imu"] = SynthImuConfig()
    if options["--uncalibrated"]:
        changed["sensor"] = start.sensor.model_copy(update=UNCALIBRATED)
    config = overridden(start.model_copy(update=changed), settings=settings)
    with output.progress().stage("render") as report:
        write_tum_log(out, config, on_progress=report)


def _write_lidar_log(
    out: Path, name: SceneName, options: Mapping[str, object], settings: dict[str, object], output: Output
) -> None:
    from mapper.config.loading import overridden
    from mapper.simulation.config import (
        LIDAR_SCENES,
        MOVING_OUTDOORS,
        PEDESTRIANS,
        SynthImuConfig,
        SynthWheelsConfig,
    )
    from mapper.simulation.gnss_config import SynthGnssConfig
    from mapper.simulation.lidar import write_lidar_log

    start = _scene(LIDAR_SCENES, name, "lidar")
    changed: dict[str, object] = {}
    if options["--moving"]:
        changed |= MOVING_OUTDOORS if name == "street" else PEDESTRIANS
    if options["--wheels"]:
        changed["wheels"] = SynthWheelsConfig()
    if options["--imu"]:
        changed["imu"] = SynthImuConfig()
    if options["--gnss"]:
        changed["gnss"] = SynthGnssConfig()
    config = overridden(start.model_copy(update=changed), settings=settings)
    with output.progress().stage("scan") as report:
        write_lidar_log(out, config, on_progress=report)


def _line_laser(
    out: Path, given: dict[str, object], noise: float | None, set_: list[str] | None, output: Output
) -> Answer:
    from mapper.config.loading import overridden
    from mapper.line_laser.config import LineLaserSynthConfig
    from mapper.line_laser.synthetic_log import write_line_laser_log

    usual = LineLaserSynthConfig()
    if noise is not None:
        given["noise_levels"] = noise * usual.noise_levels
    config = overridden(usual, settings=settings_of(given, set_))
    write_line_laser_log(out, config, progress=output.progress())
    vehicle = f"--wheelbase {config.wheelbase_m:g} --sensor-x {config.sensor_x_m:g}"
    return Answer(
        {"path": out, "format": "line laser"},
        f"{out}: a drive with a line laser; calibrate with mapper sensor line-laser-calibrate "
        f"{out}/shots --reach {config.reach_m:g} {vehicle} --out C.toml",
    )


def _scene(known: Mapping[str, Settings], name: SceneName, sensor: SensorKind) -> Settings:
    if name not in known:
        raise ConfigError(
            f"--scene {name}: has no meaning with --sensor {sensor}; want one of {', '.join(known)}"
        )
    return known[name]


def _at_wall(distance_m: float | None) -> dict[str, object]:
    from mapper.simulation.config import SynthConfig

    if distance_m is None:
        return {}
    return {
        "path": "wall",
        "wall_distance_m": distance_m,
        "room_size_m": max(SynthConfig().room_size_m, 1.2 * distance_m),
        "furniture_per_room": 0,
        "posters_per_room": 0,
        "shake_m": 0.0,
        "shake_rad": 0.0,
    }


def _camera_noise(noise: float | None) -> dict[str, object]:
    from mapper.simulation.config import SensorConfig

    if noise is None:
        return {}
    usual = SensorConfig()
    noise = 0.0 if noise < _LEAST_NOISE else noise
    return {
        "sensor.axial_noise_ratio": noise,
        "sensor.lateral_noise_px": noise * usual.lateral_noise_px,
        "sensor.disparity_step_px": noise * usual.disparity_step_px,
        "sensor.image_noise_levels": noise * usual.image_noise_levels,
        "sensor.dropout_ratio": min(noise * usual.dropout_ratio, 1.0),
    }


def _lidar_noise(noise: float | None) -> dict[str, object]:
    from mapper.simulation.config import LidarSensorConfig

    if noise is None:
        return {}
    usual = LidarSensorConfig()
    return {
        "sensor.range_noise_m": noise * usual.range_noise_m,
        "sensor.dropout_ratio": min(noise * usual.dropout_ratio, 0.99),
    }
