"""Scans of a folder of images, and one map of log-odds (Moravec & Elfes 1985) at poses by the wheels."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, starmap
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError, MapSizeError, SourceError
from mapper.core.geometry import Array, Points
from mapper.core.timebase import NS_PER_S, Stamps, seconds_text_from_ns
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.line_laser.config import LineLaserCalibration, LineLaserConfig, LineLaserMapConfig
from mapper.line_laser.ranging import LineScan, scan_image
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.slice import SEEN_FREE, SEEN_OCCUPIED
from mapper.octree.sparse_grid import log_odds
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.wheel_kinematics import pose_at
from mapper.sources.config import WheelsConfig
from mapper.sources.image_files.reading import read_colour
from mapper.sources.wheel_files import read_wheels_file

_MARGIN_CELLS = 2
_MAX_CELLS = 200_000_000
_SUBCELL_BITS = 4


def map_scans(
    scans: Sequence[LineScan],
    T_world_sensor: Array,
    config: LineLaserMapConfig,
    *,
    progress: Progress = SILENT,
) -> OccupancyGrid:
    """Return the map of all scans: occupied where the stripe was, free between there and the sensor.

    Each scan changes a cell once, and a hit goes before a miss; the log-odds are clamped (Hornung et al.
    2013, §3.4), so that the map follows what changes. Free is where nothing reaches up to the sheet of light:
    what is low is seen from afar only, where the sheet is low too.

    Args:
        scans: The scan of each image, in order.
        T_world_sensor: (N, 4, 4) where the sensor was, x ahead, y left; only the plane counts.
        config: Size of a cell and the probabilities.
        progress: Receives the count of scans.

    Raises:
        DataError: No scan saw anything.
        MapSizeError: The poses are so far apart that the grid would not fit.
    """
    ends_world = [
        scan.points_sensor @ T[:2, :2].T + T[:2, 3] for scan, T in zip(scans, T_world_sensor, strict=True)
    ]
    if not any(map(len, ends_world)):
        raise DataError("line laser: no image shows a stripe, so there is nothing to map")
    seen = np.concatenate([*ends_world, T_world_sensor[:, :2, 3]])
    low = np.floor(seen.min(axis=0) / config.resolution_m).astype(np.int64) - _MARGIN_CELLS
    size = np.floor(seen.max(axis=0) / config.resolution_m).astype(np.int64) + _MARGIN_CELLS + 1 - low
    if math.prod(size.tolist()) > _MAX_CELLS:
        raise MapSizeError(
            f"line laser: a map of {size[0]} × {size[1]} cells, want {_MAX_CELLS} at most; "
            "are the wheels right? else raise map.resolution_m"
        )
    odds = np.zeros(size[::-1], np.float32)
    known = np.zeros(odds.shape, np.bool_)
    with progress.stage("map") as report:
        for done, (scan, ends, T) in enumerate(zip(scans, ends_world, T_world_sensor, strict=True), start=1):
            corners = np.concatenate([T[None, :2, 3], ends]) / config.resolution_m - low
            _update(odds, known, scan, corners, config)
            report(done, len(scans))
    states = np.full(odds.shape, UNKNOWN, np.int8)
    states[known] = np.where(odds[known] > 0.0, OCCUPIED, FREE)
    return OccupancyGrid(states, low * config.resolution_m, config.resolution_m)


def _update(
    odds: NDArray[np.float32],
    known: NDArray[np.bool_],
    scan: LineScan,
    corners: Points,
    config: LineLaserMapConfig,
) -> None:
    """Add one scan to the log-odds; ``corners`` are the sensor and then the scan's ends, in cells (x, y)."""
    first = np.floor(corners.min(axis=0)).astype(np.int64) - 1
    last = np.floor(corners.max(axis=0)).astype(np.int64) + 2
    window = (slice(first[1], last[1]), slice(first[0], last[0]))
    local = corners - first
    states = np.zeros(last[::-1] - first[::-1], np.uint8)
    for run in _neighbours(scan.columns):
        ray = np.concatenate([local[:1], local[1:][run]]) - 0.5
        fixed = np.rint(ray * (1 << _SUBCELL_BITS)).astype(np.int32)
        cv2.fillPoly(states, [fixed], SEEN_FREE, shift=_SUBCELL_BITS)
    columns, rows = np.floor(local[1:][~scan.is_floor]).astype(np.int64).T
    states[rows, columns] = SEEN_OCCUPIED
    miss, hit = log_odds(config.miss_probability), log_odds(config.hit_probability)
    lowest, highest = log_odds(config.clamp_min_probability), log_odds(config.clamp_max_probability)
    change = np.array([0.0, miss, hit], np.float32)
    odds[window] = np.clip(odds[window] + change[states], lowest, highest)
    known[window] |= states > 0


def _neighbours(columns: NDArray[np.int64]) -> Iterator[slice]:
    """Yield the runs of columns without a gap: nothing is known of what lies between others."""
    breaks = np.flatnonzero(np.diff(columns) > 1) + 1
    bounds = [0, *breaks.tolist(), len(columns)]
    yield from starmap(slice, pairwise(bounds))


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Scans with their poses by wheel odometry.

    Attributes:
        scans: Scans whose pose is known.
        trajectory: T_world_sensor of each.
        grid: The map.
        notes: Sentences on what was left out.
    """

    scans: Sequence[LineScan]
    trajectory: Trajectory
    grid: OccupancyGrid
    notes: Sequence[str]


def scan_images(
    images: Sequence[Path],
    stamps_ns: Stamps,
    calibration: LineLaserCalibration,
    config: LineLaserConfig,
    *,
    progress: Progress = SILENT,
) -> tuple[dict[Path, LineScan], list[str]]:
    """Return the scan of each image that can be read, and notes on those that cannot.

    Raises:
        SourceError: None can be read.
        DataError: An image has another size than the calibration.
    """

    def scanned(index: int) -> LineScan | FrameError:
        path = images[index]
        try:
            image = read_colour(path)
        except FrameError as error:
            return error
        try:
            return scan_image(image, calibration, config, stamp_ns=int(stamps_ns[index]))
        except DataError as error:
            raise DataError(f"{path}: {error}") from None

    scans: dict[Path, LineScan] = {}
    notes: list[str] = []
    with progress.stage("scan") as report:
        results = ordered_map(scanned, range(len(images)))
        for done, (path, result) in enumerate(zip(images, results, strict=True), start=1):
            if isinstance(result, FrameError):
                notes.append(f"{result}; left out")
            else:
                scans[path] = result
            report(done, len(images))
    if not scans:
        raise SourceError(f"{notes[0]}; nor can the other {len(images) - 1} images be read")
    return scans, notes


def sensor_poses(wheels: Path, calibration: LineLaserCalibration) -> tuple[Trajectory, list[str]]:
    """Return T_world_sensor by wheel odometry, and notes; the world's origin is the rear axle's first pose.

    Args:
        wheels: ``encoders.txt`` or ``wheels.txt``, or a file of either kind.
        calibration: Gives the vehicle that carries the sensor.

    Raises:
        SourceError: The file is malformed, or the wheelbase is needed and unknown.
    """
    vehicle = calibration.vehicle
    mounted = WheelsConfig(
        wheelbase_m=vehicle.wheelbase_m, body_in_base=(vehicle.sensor_x_m, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    )
    return read_wheels_file(
        wheels,
        mounted,
        sensor="lidar",
        wheelbase_by="calibrate with --wheelbase, or set wheelbase_m under [vehicle] in the calibration",
    )


def drive(
    scans: Sequence[LineScan],
    T_world_sensor: Trajectory,
    config: LineLaserMapConfig,
    *,
    progress: Progress = SILENT,
) -> Drive:
    """Return the map of scans at their poses by wheel odometry.

    Args:
        scans: Scans in time order.
        T_world_sensor: Sensor poses by wheel odometry.
        config: Settings of the map.
        progress: Receives the count of scans.

    Raises:
        DataError: No image was taken while the wheels were read, or none shows a stripe.
    """
    gap_ns = int(config.max_wheel_gap_s * NS_PER_S)
    placed = [(scan, pose_at(T_world_sensor, scan.stamp_ns, max_gap_ns=gap_ns)) for scan in scans]
    known = [(scan, T) for scan, T in placed if T is not None]
    if not known:
        raise DataError(
            "wheels: no image was taken between two of their readings; images begin at "
            f"{seconds_text_from_ns(scans[0].stamp_ns)} s, readings at "
            f"{seconds_text_from_ns(int(T_world_sensor.stamps_ns[0]))} s: are they of one clock?"
        )
    lost = len(scans) - len(known)
    notes = [f"no wheel pose for {lost} images; these are not in the map"] if lost else []
    trajectory = trajectory_from((scan.stamp_ns, T) for scan, T in known)
    kept = [scan for scan, _ in known]
    return Drive(kept, trajectory, map_scans(kept, trajectory.T_world_body, config, progress=progress), notes)
