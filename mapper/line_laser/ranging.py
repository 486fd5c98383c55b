"""Ranges from the stripe's rows, and the local grid before the vehicle (Somlyai, PhD thesis, alg. 2)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Image
from mapper.core.geometry import Array, Points
from mapper.line_laser.calibration import ahead_m, right_m, row_px
from mapper.line_laser.config import LineLaserCalibration, LineLaserConfig, LineLaserMapConfig
from mapper.line_laser.detection import combined, stripe_rows


@dataclass(frozen=True, slots=True, eq=False)
class LineScan:
    """Ranges measured in one image.

    Attributes:
        stamp_ns: Time of capture.
        columns: (N,) increasing columns of the image in which a stripe was found.
        rows_px: (N,) its row in each.
        points_sensor: (N, 2) metres, x ahead and y to the left.
        is_floor: (N,) whether the laser met nothing before the floor.
    """

    stamp_ns: int
    columns: NDArray[np.int64]
    rows_px: Array
    points_sensor: Points
    is_floor: NDArray[np.bool_]


def scan_image(
    image: Image, calibration: LineLaserCalibration, config: LineLaserConfig, *, stamp_ns: int
) -> LineScan:
    """Return where the combined detector sees the laser end.

    Raises:
        DataError: The image has another size than the calibration.
    """
    want = (calibration.height_px, calibration.width_px)
    if image.shape[:2] != want:
        raise DataError(
            f"image of {image.shape[1]}×{image.shape[0]} px, but the calibration is for {want[1]}×{want[0]}; "
            "calibrate for these images"
        )
    found = combined(image, config.stripe)
    # What is seen below the floor's stripe can only be its mirror image, or no stripe at all.
    lowest = round(row_px(calibration, calibration.reach_m + config.map.floor_margin_m))
    rows = stripe_rows(found[: lowest + 1], join_px=config.stripe.join_px)
    return line_scan(rows, calibration, config.map, stamp_ns=stamp_ns)


def line_scan(
    rows_px: Array, calibration: LineLaserCalibration, config: LineLaserMapConfig, *, stamp_ns: int
) -> LineScan:
    """Return the points of (W,) rows of the stripe, NaN where there is none."""
    columns = np.flatnonzero(np.isfinite(rows_px))
    rows = rows_px[columns]
    x = ahead_m(calibration, rows)
    points = np.column_stack([x, -right_m(calibration, columns.astype(np.float64), rows)])
    return LineScan(stamp_ns, columns, rows, points, x >= calibration.reach_m - config.floor_margin_m)


def local_grid(scan: LineScan, config: LineLaserMapConfig) -> NDArray[np.uint8]:
    """Return D[r, e] (Somlyai, PhD thesis, alg. 2): 1 where something stands.

    Row 0 is at the vehicle, and the middle column ahead of it; columns go to the right.
    """
    obstacles = scan.points_sensor[~scan.is_floor]
    r = np.floor(obstacles[:, 0] / config.cell_m).astype(np.int64)
    e = np.floor(-obstacles[:, 1] / config.cell_m).astype(np.int64) + config.width_cells // 2
    inside = (r < config.depth_cells) & (e >= 0) & (e < config.width_cells)
    D = np.zeros((config.depth_cells, config.width_cells), np.uint8)
    D[r[inside], e[inside]] = 1
    return D
