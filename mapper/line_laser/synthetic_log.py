"""A synthetic drive with a line laser on disk: images, labels, encoders, truth, and shots to calibrate by."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Transform, transform
from mapper.core.timebase import NS_PER_S, Stamps, seconds_text_from_ns
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.line_laser.config import LineLaserSynthConfig
from mapper.line_laser.files import SHOTS
from mapper.line_laser.rendering import Room, Shot, curvature_at, lap_m, make_board, make_room, take
from mapper.runtime.atomic import new_folder, write_json
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.wheel_kinematics import driven, pose_at
from mapper.simulation.streams import Stream, rng_of
from mapper.sources.trajectory_files import write_tum

BOARD_M = 0.4
_BOARD_STEP_M = 0.2  # as in Somlyai (PhD thesis), §2.5.3: every 20 cm nearer
_NEAREST_M = 0.5
_START_NS = 1_000 * NS_PER_S
_READING_NS, _FINE_NS = 50_000_000, 20_000_000
_TICK_M = 0.002  # of path between two ticks of the encoder
_STEERING_NOISE_RAD = 0.003


def write_line_laser_log(out: Path, config: LineLaserSynthConfig, *, progress: Progress = SILENT) -> None:
    """Write images, their labels, encoder readings, the truth, shots to calibrate by, and the scene itself.

    The folder appears when it is complete.

    Args:
        out: Folder to make; it must not exist.
        config: Settings of the drive and the sensor.
        progress: Receives the count of images.

    Raises:
        SourceError: ``out`` exists, or cannot be written.
    """
    room = make_room(config)
    T_world_sensor = sensor_poses(config)
    with new_folder(out) as folder:
        (folder / "images").mkdir()
        labels = ["image,column,row_px,range_m"]

        def image_at(index: int) -> tuple[str, Shot]:
            name = f"{seconds_text_from_ns(int(T_world_sensor.stamps_ns[index]))}.jpg"
            rng = rng_of(config.seed, Stream.SENSOR, index)
            shot = take(room, config, T_world_sensor.T_world_body[index], rng=rng)
            (folder / "images" / name).write_bytes(shot.jpeg)
            return name, shot

        with progress.stage("render") as report:
            shots = ordered_map(image_at, range(len(T_world_sensor)))
            for done, (name, shot) in enumerate(shots, start=1):
                labels.extend(
                    f"{name},{column},{shot.rows[column]:.3f},{shot.ranges_m[column]:.4f}"
                    for column in np.flatnonzero(np.isfinite(shot.rows))
                )
                report(done, len(T_world_sensor))
        (folder / "labels.csv").write_text("\n".join(labels) + "\n", encoding="utf-8")
        (folder / "encoders.txt").write_text(_encoders_text(config), encoding="utf-8")
        write_tum(folder / "groundtruth.txt", T_world_sensor)
        _write_shots(folder / "shots", config)
        scene = {"config": config.model_dump(mode="json"), "walls_world_m": room.ends_world.tolist()}
        write_json(folder / "scene.json", scene, indent=1)


def sensor_poses(config: LineLaserSynthConfig) -> Trajectory:
    """Return T_world_sensor at every image; the rear axle begins at the world's origin, looking along x.

    Raises:
        DataError: The drive is too short for two images.
    """
    lap_ns = int(lap_m() / config.speed_mps * NS_PER_S)
    duration_ns = lap_ns if config.duration_s is None else int(config.duration_s * NS_PER_S)
    stamps_ns = _START_NS + np.arange(0, duration_ns, int(NS_PER_S / config.rate_hz), dtype=np.int64)
    if len(stamps_ns) < 2:
        raise DataError(
            f"a drive of {duration_ns / NS_PER_S:g} s at {config.rate_hz:g} images/s has {len(stamps_ns)}; "
            "raise duration_s"
        )
    fine_ns = np.arange(_START_NS, stamps_ns[-1] + 2 * _FINE_NS, _FINE_NS, dtype=np.int64)
    path_m = config.speed_mps * (fine_ns - _START_NS) / NS_PER_S
    axle = driven(fine_ns, path_m, _steering(config, path_m), wheelbase_m=config.wheelbase_m)
    T_axle_sensor = transform(np.eye(3), np.array([config.sensor_x_m, 0.0, 0.0]))
    return trajectory_from(
        (int(stamp_ns), T_world_axle @ T_axle_sensor) for stamp_ns, T_world_axle in _at(axle, stamps_ns)
    )


def calibration_boards(config: LineLaserSynthConfig) -> Iterator[tuple[float, Room]]:
    """Yield how far ahead a plain board stands, and the board, farthest first."""
    plain = config.model_copy(update={"lamps": 0.0, "red_things": 0.0, "dull_things": 0.0})
    steps = int((config.reach_m - _NEAREST_M) / _BOARD_STEP_M + 1e-6)
    for step in range(1, steps + 1):
        range_m = round(config.reach_m - _BOARD_STEP_M * step, 6)
        yield range_m, make_board(plain, range_m=range_m, width_m=BOARD_M)


def _write_shots(folder: Path, config: LineLaserSynthConfig) -> None:
    folder.mkdir()
    lines = ["image,range_m,width_m"]
    for index, (range_m, board) in enumerate(calibration_boards(config)):
        name = f"board_{1e3 * range_m:04.0f}mm.jpg"
        shot = take(board, config, np.eye(4), rng=rng_of(config.seed, Stream.DROPS, index))
        (folder / name).write_bytes(shot.jpeg)
        lines.append(f"{name},{range_m!r},{BOARD_M!r}")
    (folder / SHOTS).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _encoders_text(config: LineLaserSynthConfig) -> str:
    """Return readings of encoder and steering: whole ticks, and a noisy angle."""
    last_ns = int(sensor_poses(config).stamps_ns[-1])
    stamps_ns = np.arange(_START_NS, last_ns + _READING_NS, _READING_NS, dtype=np.int64)
    path_m = config.speed_mps * (stamps_ns - _START_NS) / NS_PER_S
    noise_rad = rng_of(config.seed, Stream.PATH).normal(0.0, _STEERING_NOISE_RAD, len(path_m))
    steering_rad = _steering(config, path_m) + noise_rad
    path_m = np.floor(path_m / _TICK_M) * _TICK_M
    lines = [
        f"{seconds_text_from_ns(int(stamp_ns))} {path:.6f} {angle:.6f}"
        for stamp_ns, path, angle in zip(stamps_ns, path_m, steering_rad, strict=True)
    ]
    return "\n".join(["# stamp path_m steering_rad", *lines]) + "\n"


def _steering(config: LineLaserSynthConfig, path_m: Array) -> Array:
    return np.arctan(config.wheelbase_m * curvature_at(path_m))


def _at(axle: Trajectory, stamps_ns: Stamps) -> Iterator[tuple[int, Transform]]:
    for stamp_ns in stamps_ns:
        T_world_axle = pose_at(axle, int(stamp_ns), max_gap_ns=_FINE_NS)
        if T_world_axle is not None:
            yield int(stamp_ns), T_world_axle
