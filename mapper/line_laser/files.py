"""Folders of a line-laser sensor: its images, the shots it is calibrated by, and what is written of both."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from mapper.core.errors import SourceError
from mapper.core.frames import Image
from mapper.core.timebase import Stamps, seconds_text_from_ns
from mapper.export.figures import ESTIMATE
from mapper.export.grid import write_grid
from mapper.export.mesh_files import write_ply
from mapper.export.picture import write_summary
from mapper.line_laser.calibration import CalibrationShot, calibration_text, find_board
from mapper.line_laser.config import LineLaserCalibration, LineLaserConfig, StripeConfig
from mapper.line_laser.ranging import LineScan, local_grid
from mapper.line_laser.survey import Drive
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, atomic_file, write_bytes, write_json, write_text
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.image_files.reading import read_colour
from mapper.sources.scan_stamps import Wording, in_order, scan_stamps
from mapper.sources.text import parse_numbers, rows, time_order
from mapper.sources.trajectory_files import write_tum

SHOTS = "shots.csv"
_TIMES = "times.txt"
_IMAGES = Wording("images", rate="--set rate_hz", stamps_file="--times")
_ENDINGS = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".tif", ".tiff"})
RANGES, LOCAL, MAP, MAP_PICTURE = "ranges.csv", "local", "map", "map_and_path.png"
POINTS, TRAJECTORY, CALIBRATION = "points.ply", "trajectory.txt", "calibration.toml"
DETECTIONS, RANGE_ERRORS, DETECTION_VIEWS = "detections.csv", "range_errors.csv", "detection_*.png"
FOLDER = FolderKind(
    "a line laser's ranges",
    manifest_keys=frozenset({"images", "config", "notes"}),
    files=frozenset(
        {RANGES, LOCAL, MAP_PICTURE, POINTS, TRAJECTORY, CALIBRATION}
        | {
            DETECTIONS,
            RANGE_ERRORS,
            DETECTION_VIEWS,
            *(f"{MAP}{ending}" for ending in (".pgm", ".yaml", ".png")),
        }
    ),
)


def find_images(
    folder: Path, *, times: Path | None = None, rate_hz: float | None = None
) -> tuple[list[Path], Stamps, list[str]]:
    """Return a folder's images in time order, their stamps, and notes on what was assumed.

    Args:
        folder: Folder of images; stamps are in their names, or in ``times.txt`` in it or beside it.
        times: List of stamps that goes before both.
        rate_hz: Images a second without any stamps; None is 10.

    Raises:
        SourceError: There is no such folder, or no image in it, or the list does not fit.
    """
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; want a folder of images")
    images = in_order(path for path in folder.iterdir() if path.suffix.lower() in _ENDINGS)
    if not images:
        inside = "; those in images/?" if (folder / "images").is_dir() else ""
        raise SourceError(f"{folder}: no images; want files ending in {' '.join(sorted(_ENDINGS))}{inside}")
    lists = (folder / _TIMES, folder.parent / _TIMES)
    times_file = next((path for path in lists if path.is_file()), None)
    stamps_ns, notes = scan_stamps(images, chosen=times, beside=times_file, rate_hz=rate_hz, wording=_IMAGES)
    order, more = time_order(stamps_ns, what="images")
    return [images[i] for i in order], stamps_ns[order], [*notes, *more]


def read_shots(
    path: Path, config: StripeConfig, *, progress: Progress = SILENT
) -> tuple[list[CalibrationShot], tuple[int, int], list[str]]:
    """Return what the shots of a calibration show, the images' width and height, and notes on what does not.

    Args:
        path: Lines ``image,range_m[,width_m]``, or the folder with such a ``shots.csv``: images of a board
            that faces the sensor, in the middle of the image, and how far and how wide it is.
        config: Settings of the stripe detection.
        progress: Receives the count of images.

    Raises:
        SourceError: A file is missing or malformed, or the images differ in size.
    """
    path = path / SHOTS if path.is_dir() else path
    lines = [(number, words) for number, words in rows(path, separator=",") if words[0] != "image"]
    shots: list[CalibrationShot] = []
    notes: list[str] = []
    size_px = (0, 0)
    with progress.stage("shots") as report:
        for done, (number, words) in enumerate(lines, start=1):
            where = f"{path}:{number}"
            image = read_colour(path.parent / words[0])
            if size_px not in ((0, 0), image.shape[1::-1]):
                raise SourceError(
                    f"{where}: image of {image.shape[1]}×{image.shape[0]} px, "
                    f"but those above are {size_px[0]}×{size_px[1]}"
                )
            size_px = (image.shape[1], image.shape[0])
            shot, note = _seen(image, words, config, where)
            shots.extend(shot)
            notes.extend(note)
            report(done, len(lines))
    return shots, size_px, notes


def _seen(
    image: Image, words: Sequence[str], config: StripeConfig, where: str
) -> tuple[list[CalibrationShot], list[str]]:
    """Return one shot, or none, and a note on what it does not show."""
    if len(words) not in (2, 3):
        raise SourceError(f"{where}: {len(words)} columns, want image,range_m or image,range_m,width_m")
    numbers = parse_numbers([word for word in words[1:] if word], where=where)
    if not len(numbers) or not (np.isfinite(numbers) & (numbers > 0.0)).all():
        raise SourceError(f"{where}: want a range and a width in metres, both > 0")
    seen = find_board(image, config)
    if seen is None:
        return [], [f"{where}: {words[0]} shows no level stripe in its middle; left out"]
    range_m, *width_m = (float(number) for number in numbers)
    if width_m and seen.width_px is None:
        return [CalibrationShot(seen, range_m)], [f"{where}: the board leaves {words[0]}; width not used"]
    return [CalibrationShot(seen, range_m, *width_m)], []


def write_scans(
    folder: Path,
    scans: Mapping[Path, LineScan],
    *,
    calibration: LineLaserCalibration,
    config: LineLaserConfig,
    notes: Sequence[str],
) -> None:
    """Write ``ranges.csv``, the local grids as images in ``local/``, the calibration and the manifest.

    In a local grid's image a pixel is a cell and white is an obstacle, as in the thesis; the vehicle is in
    the middle of the lowest row and looks up.

    Args:
        folder: Existing folder.
        scans: Scans by the names of their images.
        calibration: Calibration that was used.
        config: Likewise.
        notes: Sentences on what was left out or assumed.
    """
    (folder / LOCAL).mkdir()
    with atomic_file(folder / RANGES) as partial, partial.open("w", encoding="utf-8") as ranges:
        ranges.write("image,stamp_s,column,row_px,x_m,y_m,is_floor\n")
        for path, scan in scans.items():
            ranges.writelines(_lines(path.name, scan))
            _, png = cv2.imencode(".png", 255 * local_grid(scan, config.map)[::-1])
            write_bytes(folder / LOCAL / f"{path.stem}.png", png.tobytes())
    write_text(folder / CALIBRATION, calibration_text(calibration))
    manifest = {"images": len(scans), "config": config.model_dump(mode="json"), "notes": list(notes)}
    write_json(folder / MANIFEST_NAME, manifest, indent=1)


def _lines(image: str, scan: LineScan) -> Iterator[str]:
    stamp = seconds_text_from_ns(scan.stamp_ns)
    rows = zip(
        scan.columns.tolist(),
        scan.rows_px.tolist(),
        scan.points_sensor.tolist(),
        scan.is_floor.tolist(),
        strict=True,
    )
    for column, row, (x, y), is_floor in rows:
        yield f"{image},{stamp},{column},{row:.3f},{x:.4f},{y:.4f},{int(is_floor)}\n"


def write_drive(folder: Path, drive: Drive, *, title: str) -> None:
    """Write the map for ROS and as a picture with the path, the points of all scans in it, and the path."""
    write_grid(folder, MAP, drive.grid)
    write_tum(folder / TRAJECTORY, drive.trajectory)
    obstacles = [
        scan.points_sensor[~scan.is_floor] @ T[:2, :2].T + T[:2, 3]
        for scan, T in zip(drive.scans, drive.trajectory.T_world_body, strict=True)
    ]
    flat = np.concatenate(obstacles)
    points = np.column_stack([flat, np.zeros(len(flat))]).astype(np.float32)
    write_ply(folder / POINTS, points, np.tile(np.array(ESTIMATE, np.uint8), (len(points), 1)))
    write_summary(
        folder / MAP_PICTURE,
        grid=drive.grid,
        trajectory=drive.trajectory,
        truth=None,
        loops_world=np.empty((0, 2, 3)),
        title=title,
        lines=[
            f"{len(drive.scans)} images, {len(points)} points, "
            f"{drive.trajectory.path_length_m:.2f} m by the wheels, cells of {drive.grid.resolution_m:g} m"
        ],
    )
