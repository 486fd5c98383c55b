"""Study of the line-laser sensor on rendered images: detections of every method and Table 2.1, by seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from mapper.core.frames import Image
from mapper.core.geometry import Array, Transform
from mapper.evaluators.sensors.line_laser import PERCENT, TABLE_2_1, Counts, count_all, summed
from mapper.evaluators.study.table import Column, Record, Table, Value
from mapper.line_laser.calibration import CalibrationShot, calibrate, find_board
from mapper.line_laser.config import (
    LineLaserCalibration,
    LineLaserConfig,
    LineLaserSynthConfig,
    VehicleConfig,
)
from mapper.line_laser.detection import METHODS, Method
from mapper.line_laser.ranging import scan_image
from mapper.line_laser.rendering import Room, make_board, make_room, take
from mapper.line_laser.synthetic_log import BOARD_M, calibration_boards, sensor_poses
from mapper.runtime.progress import SILENT, Progress
from mapper.simulation.streams import Stream, rng_of
from mapper.sources.image_files.reading import decode_colour

SCENES: Mapping[str, Mapping[str, float]] = {
    "bare": {"lamps": 0.0, "red_things": 0.0, "dull_things": 0.0},
    "usual": {},
    "lamps": {"lamps": 1.5, "red_things": 0.0},
    "red things": {"lamps": 0.0, "red_things": 3.0},
    "both": {"lamps": 1.5, "red_things": 3.0},
    "bright": {"ambient": 0.9},
    "dark": {"ambient": 0.2},
    "noisy": {"noise_levels": 8.0},
}
"""The settings that each scene changes."""

IMAGES_PER_SCENE = 6
_WALL_M = 6.0  # wider than the image


@dataclass(frozen=True, slots=True)
class Study:
    """Results of the study, one for each seed.

    Attributes:
        found: Counts of each method's detections, by scene.
        measured_m: Measured range, the median over the columns of an image, by true range.
    """

    found: Mapping[str, Sequence[Mapping[Method, Counts]]]
    measured_m: Mapping[float, Sequence[float]]


_STUDY_COLUMNS = (
    Column("scene", "scene"),
    Column("method", "method"),
    Column("precision", "precision %", PERCENT),
    Column("recall", "recall %", PERCENT),
    Column("f_score", "F %", PERCENT),
    Column("f_score_low", "lowest F %", PERCENT),
    Column("f_score_high", "highest F %", PERCENT),
    Column("pixel_f_score", "pixels' F %", PERCENT),
    Column("best_in_seeds", "best in seeds"),
)
_TABLE_COLUMNS = (
    Column("range_m", "true m", "{:.2f}".format),
    Column("measured_m", "measured m", "{:.3f}".format),
    Column("error_ratio", "error %", PERCENT),
    Column("worst_error_ratio", "worst seed's %", PERCENT),
    Column("thesis_measured_m", "thesis m", "{:.2f}".format),
    Column("thesis_error_ratio", "thesis %", PERCENT),
)


def study(config: LineLaserConfig, seeds: Sequence[int], *, progress: Progress = SILENT) -> Study:
    """Render every scene, and a wall at every range of Table 2.1, with every seed; shots calibrate.

    Args:
        config: Settings of the stripe detection.
        seeds: Each another room, other things on its walls and other noise.
        progress: Receives the count of scenes and seeds, and of Table 2.1.
    """
    found: dict[str, list[Mapping[Method, Counts]]] = {name: [] for name in SCENES}
    measured_m: dict[float, list[float]] = {range_m: [] for range_m in TABLE_2_1}
    with progress.stage("study") as report:
        for done, seed in enumerate(seeds):
            usual = LineLaserSynthConfig(seed=seed)
            calibration = _calibrated(usual, config)
            for index, range_m in enumerate(TABLE_2_1):
                measured_m[range_m].append(_measured(usual, calibration, config, range_m, index))
            for step, (name, changes) in enumerate(SCENES.items()):
                scene = usual.model_copy(update=dict(changes))
                found[name].append(_found(scene, config))
                report(done * len(SCENES) + step + 1, len(seeds) * len(SCENES))
    return Study(found, measured_m)


def detections(study: Study) -> Table:
    """Return one record for each scene and method: medians and spread over the seeds."""
    records: list[Record] = []
    for name, seeds in study.found.items():
        best = [max(METHODS, key=lambda method: seed[method].columns[2]) for seed in seeds]
        for method in METHODS:
            spread = _spread([seed[method] for seed in seeds])
            records.append({"scene": name, "method": method, **spread, "best_in_seeds": best.count(method)})
    return Table(_STUDY_COLUMNS, records)


def table_2_1(study: Study) -> Table:
    """Return Table 2.1: what was measured, in whole centimetres as printed there, and its relative error."""
    records: list[Record] = []
    for range_m, measured_m in study.measured_m.items():
        errors = [abs(round(value, 2) - range_m) / range_m for value in measured_m]
        exact = [abs(value - range_m) / range_m for value in measured_m]
        records.append(
            {
                "range_m": range_m,
                "measured_m": median(measured_m),
                "error_ratio": median(errors),
                "worst_error_ratio": max(errors),
                "exact_error_ratio": median(exact),
                "thesis_measured_m": TABLE_2_1[range_m],
                "thesis_error_ratio": abs(TABLE_2_1[range_m] - range_m) / range_m,
            }
        )
    return Table(_TABLE_COLUMNS, records)


def _spread(counts: Sequence[Counts]) -> dict[str, Value]:
    precision, recall, f_score = np.array([one.columns for one in counts]).T
    pixel_f_score = np.array([one.pixels[2] for one in counts])
    return {
        "precision": float(np.median(precision)),
        "recall": float(np.median(recall)),
        "f_score": float(np.median(f_score)),
        "f_score_low": float(f_score.min()),
        "f_score_high": float(f_score.max()),
        "pixel_f_score": float(np.median(pixel_f_score)),
    }


def _calibrated(synth: LineLaserSynthConfig, config: LineLaserConfig) -> LineLaserCalibration:
    shots: list[CalibrationShot] = []
    for index, (range_m, room) in enumerate(calibration_boards(synth)):
        image, _ = _photo(synth, room, np.eye(4), Stream.DROPS, index)
        if board := find_board(image, config.stripe):
            shots.append(CalibrationShot(board, range_m, BOARD_M if board.width_px else None))
    size_px = (synth.width_px, synth.height_px)
    return calibrate(shots, size_px=size_px, reach_m=synth.reach_m, vehicle=VehicleConfig()).calibration


def _measured(
    synth: LineLaserSynthConfig,
    calibration: LineLaserCalibration,
    config: LineLaserConfig,
    range_m: float,
    index: int,
) -> float:
    wall = make_board(synth, range_m=range_m, width_m=_WALL_M)
    image, _ = _photo(synth, wall, np.eye(4), Stream.MOVERS, index)
    points = scan_image(image, calibration, config, stamp_ns=0).points_sensor
    return float(np.median(points[:, 0])) if len(points) else np.nan


def _found(synth: LineLaserSynthConfig, config: LineLaserConfig) -> dict[Method, Counts]:
    """Return the counts of every method in images taken all the way round the room."""
    room, poses = make_room(synth), sensor_poses(synth).T_world_body
    places = np.linspace(0, len(poses), IMAGES_PER_SCENE, endpoint=False).astype(np.int64)
    photos = (_photo(synth, room, poses[place], Stream.SENSOR, int(place)) for place in places)
    return summed(count_all(image, true_rows, config.stripe) for image, true_rows in photos)


def _photo(
    synth: LineLaserSynthConfig, room: Room, T_world_sensor: Transform, stream: Stream, index: int
) -> tuple[Image, Array]:
    shot = take(room, synth, T_world_sensor, rng=rng_of(synth.seed, stream, index))
    return decode_colour(shot.jpeg, "a rendered image"), shot.rows
