"""Output files of a line-laser sensor: ranges, local grids, the map, points and pictures."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from mapper.core.timebase import seconds_text_from_ns
from mapper.export.figures import ESTIMATE
from mapper.export.grid import write_grid
from mapper.export.mesh_files import write_ply
from mapper.export.picture import write_summary
from mapper.line_laser.calibration import calibration_text
from mapper.line_laser.config import LineLaserCalibration, LineLaserConfig
from mapper.line_laser.ranging import LineScan, local_grid
from mapper.line_laser.survey import Drive
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, atomic_file, write_bytes, write_json, write_text
from mapper.sources.trajectory_files import write_tum

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
