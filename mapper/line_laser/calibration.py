"""Calibration: the laws from the stripe's pixel to a point before the vehicle, and their fit to shots."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.config import toml_text
from mapper.core.errors import DataError
from mapper.core.frames import Image
from mapper.core.geometry import Array
from mapper.line_laser.config import (
    Covariance,
    LateralLaw,
    LineLaserCalibration,
    RangeLaw,
    StripeConfig,
    VehicleConfig,
)
from mapper.line_laser.detection import combined, stripe_rows

_CM = 0.01
_MIN_RANGES, _MIN_WIDTHS = 3, 2
_CENTRE_RATIO = 0.05  # of the image's columns: the board is there
_LEVEL_PX = 3.0  # the stripe on a board that faces the camera is this straight
_GAP_PX = 6  # columns of it that may be missing


@dataclass(frozen=True, slots=True)
class Board:
    """The stripe on a board that faces the camera, in the middle of the image.

    Attributes:
        row_px: Its mean row, 0 the middle of the top one.
        width_px: Number of columns that it spans; None if it leaves the image.
    """

    row_px: float
    width_px: int | None


@dataclass(frozen=True, slots=True)
class CalibrationShot:
    """Measurements of one image of a board at a known place.

    Attributes:
        board: Its stripe.
        range_m: Distance of the board ahead.
        width_m: Width of the board; None if it was not measured or cannot be seen.
    """

    board: Board
    range_m: float
    width_m: float | None = None

    def __post_init__(self) -> None:
        if not self.range_m > 0.0 or not (self.width_m is None or self.width_m > 0.0):
            raise DataError(f"shot: range {self.range_m} m, width {self.width_m} m; want both > 0")
        if self.width_m is not None and self.board.width_px is None:
            raise DataError(f"shot: a board of {self.width_m} m, but the image does not show it whole")


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A calibration, and how far it is from what it was fitted to.

    Attributes:
        calibration: The laws with their covariances.
        range_errors_m: (N,) by each shot: the law's value minus the measured one.
        width_errors_m: (M,) by each shot with a width likewise.
    """

    calibration: LineLaserCalibration
    range_errors_m: Array
    width_errors_m: Array


def up_px(height_px: int, rows_px: Array) -> Array:
    """Return the heights of rows above the image's lower edge, in pixels."""
    return height_px - 0.5 - rows_px


def ahead_m(calibration: LineLaserCalibration, rows_px: Array) -> Array:
    """Return the ranges ahead of a stripe in these rows, metres (Somlyai, PhD thesis, eq. 2.44)."""
    law = calibration.range
    height = 100.0 * up_px(calibration.height_px, rows_px) / calibration.height_px
    return 1e-3 * law.scale_mm * height**law.exponent


def row_px(calibration: LineLaserCalibration, range_m: float) -> float:
    """Return the row of a stripe at a range: the inverse of :func:`ahead_m`."""
    law = calibration.range
    height = float((1e3 * range_m / law.scale_mm) ** (1.0 / law.exponent))
    return calibration.height_px * (1.0 - height / 100.0) - 0.5


def right_m(calibration: LineLaserCalibration, columns_px: Array, rows_px: Array) -> Array:
    """Return its lateral offsets, metres to the right (Somlyai, PhD thesis, eq. 2.45)."""
    law = calibration.lateral
    x = columns_px - 0.5 * (calibration.width_px - 1)
    return _CM * x / (law.slope * up_px(calibration.height_px, rows_px) + law.offset)


def find_board(image: Image, config: StripeConfig) -> Board | None:
    """Return the stripe on the board in the middle of an (H, W, 3) RGB image; None without a level one."""
    found = stripe_rows(combined(image, config), join_px=config.join_px)
    middle, half = len(found) // 2, max(int(len(found) * _CENTRE_RATIO), 1)
    centre = found[middle - half : middle + half]
    centre = centre[np.isfinite(centre)]
    level = np.flatnonzero(np.abs(found - (np.median(centre) if len(centre) else np.inf)) <= _LEVEL_PX)
    parts = np.split(level, np.flatnonzero(np.diff(level) > _GAP_PX + 1) + 1)
    board = max(parts, key=lambda columns: np.isin(columns, range(middle - half, middle + half)).sum())
    if len(board) < half:
        return None
    is_whole = board[0] > _GAP_PX and board[-1] < len(found) - 1 - _GAP_PX
    return Board(float(found[board].mean()), int(board[-1] - board[0] + 1) if is_whole else None)


def calibrate(
    shots: Sequence[CalibrationShot], *, size_px: tuple[int, int], reach_m: float, vehicle: VehicleConfig
) -> Fit:
    """Return the laws that suit shots best: by least squares in ln υ, and in px per cm.

    Args:
        shots: Shots at three ranges at least, two of them with widths.
        size_px: Width and height of the images.
        reach_m: Distance at which the laser meets the floor.
        vehicle: Vehicle that carries the sensor.

    Raises:
        DataError: Too few shots, one beyond the reach, or no law of this kind suits them.
    """
    farthest_m = max((shot.range_m for shot in shots), default=0.0)
    if not farthest_m <= reach_m:
        raise DataError(
            f"calibration: a board at {farthest_m:g} m, but the laser meets the floor at {reach_m:g} m; "
            "is the reach right?"
        )
    wide = [(s.range_m, s.board.row_px, s.board.width_px, s.width_m) for s in shots if s.width_m is not None]
    for ranges, fewest, what in (
        ({shot.range_m for shot in shots}, _MIN_RANGES, "ranges"),
        ({shot[0] for shot in wide}, _MIN_WIDTHS, "ranges of a board of known width that is seen whole"),
    ):
        if len(ranges) < fewest:
            raise DataError(f"calibration: {len(ranges)} different {what}, want {fewest} or more")
    width_px, height_px = size_px
    rows_px, ranges_m = np.array([(shot.board.row_px, shot.range_m) for shot in shots]).T
    heights = 100.0 * up_px(height_px, rows_px) / height_px
    (ln_scale, exponent), range_covariance = _line(np.log(heights), np.log(1e3 * ranges_m))
    _, wide_rows_px, widths_px, widths_m = np.array(wide, np.float64).T
    wide_up_px = up_px(height_px, wide_rows_px)
    (offset, slope), ((d, b), (_, a)) = _line(wide_up_px, widths_px / (widths_m / _CM))
    if exponent >= 0.0 or slope <= 0.0:
        raise DataError(
            f"calibration: exponent {exponent:.3g} and slope {slope:.3g}, want < 0 and > 0: what is nearer "
            "is seen higher and wider; are ranges and images paired rightly?"
        )
    calibration = LineLaserCalibration(
        width_px=width_px,
        height_px=height_px,
        reach_m=reach_m,
        range=RangeLaw(scale_mm=float(np.exp(ln_scale)), exponent=exponent, covariance=range_covariance),
        lateral=LateralLaw(slope=slope, offset=offset, covariance=((a, b), (b, d))),
        vehicle=vehicle,
    )
    return Fit(
        calibration,
        ahead_m(calibration, rows_px) - ranges_m,
        _CM * widths_px / (slope * wide_up_px + offset) - widths_m,
    )


def calibration_text(calibration: LineLaserCalibration) -> str:
    """Return the text of a calibration file."""
    return f"{toml_text(calibration.model_dump(exclude_none=True))}\n"


def _line(x: Array, y: Array) -> tuple[tuple[float, float], Covariance]:
    """Return intercept and slope of the least-squares line, and their covariance by its residuals."""
    A = np.column_stack([np.ones_like(x), x])
    intercept, slope = np.linalg.lstsq(A, y)[0]
    freedom = max(len(x) - 2, 1)
    variance = float(((A @ [intercept, slope] - y) ** 2).sum()) / freedom
    (a, b), (_, d) = variance * np.linalg.inv(A.T @ A)
    return (float(intercept), float(slope)), ((float(a), float(b)), (float(b), float(d)))
