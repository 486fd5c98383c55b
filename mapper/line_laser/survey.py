"""Scans of a folder of images, and one map of them where wheel odometry gives their poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mapper.core.errors import DataError, FrameError, SourceError
from mapper.core.timebase import NS_PER_S, Stamps, seconds_text_from_ns
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.line_laser.config import LineLaserCalibration, LineLaserConfig, LineLaserMapConfig
from mapper.line_laser.mapping import map_scans
from mapper.line_laser.ranging import LineScan, scan_image
from mapper.octree.grid import OccupancyGrid
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.wheel_kinematics import pose_at
from mapper.sources.config import WheelsConfig
from mapper.sources.image_files.reading import read_colour
from mapper.sources.wheel_files import read_wheels_file

_WORKERS = 2


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
        results = ordered_map(scanned, range(len(images)), workers=_WORKERS)
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
