"""Accuracy of a depth camera on a plane: the figures of Somlyai (PhD thesis), §2.6.1 and §2.6.2."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from statistics import median

import numpy as np

from mapper.core.errors import DataError, FrameError, SourceError
from mapper.core.frames import Image, PinholeCamera, RgbdFrame
from mapper.core.geometry import Array
from mapper.sources.base import FrameRef, Log

_WORST = 100
"""One in this number of pixels is among the worst 1 %."""


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of an image, in pixels."""

    column: int
    row: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns, to index an image by."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)

    def check_inside(self, camera: PinholeCamera) -> None:
        """Check that the patch lies in a camera's image.

        Raises:
            DataError: It reaches beyond the image, or is too small to hold a plane.
        """
        right, bottom = self.column + self.width, self.row + self.height
        if min(self.column, self.row) < 0 or right > camera.width_px or bottom > camera.height_px:
            raise DataError(
                f"patch {self}: reaches beyond the image of {camera.width_px}×{camera.height_px} px"
            )
        if min(self.width, self.height) < 3:
            raise DataError(f"patch {self}: want at least 3×3 px")

    def __str__(self) -> str:
        return f"{self.column},{self.row},{self.width},{self.height}"


def central_patch(camera: PinholeCamera) -> Patch:
    """Return the middle third of an image, each way."""
    width, height = camera.width_px // 3, camera.height_px // 3
    return Patch((camera.width_px - width) // 2, (camera.height_px - height) // 2, width, height)


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Errors of measured depths from a plane.

    Attributes:
        max_error_m: Δd, the largest error (Somlyai, PhD thesis, eq. 2.46).
        max_error_99_m: Δd without the worst 1 % of the pixels.
        mean_error_m: Positive where the plane is measured too far away.
        std_m: s, the standard deviation.
    """

    max_error_m: float
    max_error_99_m: float
    mean_error_m: float
    std_m: float


def accuracy_of(depth_m: Array, reference_m: Array | float) -> Accuracy:
    """Return the errors of depths from where they should be.

    Δd = max(|d − min δ|, |d − max δ|) is the largest |δ − d|; of n pixels the worst n // 100 are left out.

    Args:
        depth_m: Measured depths, 0 where there is none.
        reference_m: True depth of each, or of all.

    Raises:
        DataError: Nothing is measured.
    """
    errors_m = (depth_m - reference_m)[depth_m > 0.0]
    if not len(errors_m):
        raise DataError("accuracy: no pixel has a depth")
    sizes_m = np.sort(np.abs(errors_m))
    kept = len(sizes_m) - len(sizes_m) // _WORST
    return Accuracy(
        max_error_m=float(sizes_m[-1]),
        max_error_99_m=float(sizes_m[kept - 1]),
        mean_error_m=float(errors_m.mean()),
        std_m=float(errors_m.std()),
    )


def quantisation_step_m(depth_m: Array) -> float | None:
    """Return the median gap between neighbouring depths that occur; None if fewer than three do."""
    values = np.unique(depth_m[depth_m > 0.0])
    return float(np.median(np.diff(values))) if len(values) > 2 else None


@dataclass(frozen=True, slots=True)
class SeenPlane:
    """One plane in one frame.

    Attributes:
        distance_m: Distance at which it was measured.
        tilt_rad: Between its normal and the optical axis.
        measured_ratio: Share of its pixels that had a depth.
        raw: Errors of the depth image as it is.
        filtered: Errors after DIF.
        step_m: Step of quantisation; None if too few depths occur.
    """

    distance_m: float
    tilt_rad: float
    measured_ratio: float
    raw: Accuracy
    filtered: Accuracy
    step_m: float | None


def seen_plane(
    depth_m: Array, filtered_m: Array, reference_m: Array | float, *, distance_m: float, tilt_rad: float
) -> SeenPlane:
    """Return the figures of one plane.

    Args:
        depth_m: Measured depths, 0 where there is none.
        filtered_m: Measured depths after DIF.
        reference_m: True depth of each, or of all.
        distance_m: Distance at which the plane was measured.
        tilt_rad: Between its normal and the optical axis.

    Raises:
        DataError: Nothing is measured.
    """
    return SeenPlane(
        distance_m=distance_m,
        tilt_rad=tilt_rad,
        measured_ratio=float((depth_m > 0.0).mean()),
        raw=accuracy_of(depth_m, reference_m),
        filtered=accuracy_of(filtered_m, reference_m),
        step_m=quantisation_step_m(depth_m),
    )


@dataclass(frozen=True, slots=True)
class DepthLevel:
    """All planes at one distance.

    Attributes:
        name: Name of the log.
        frames: Number of frames that showed planes there.
        planes: Number of planes.
        typical: The median of each of their figures, Δd among them: the largest of all would grow with their
            number. Its distance is the true one where that is known.
        temporal_m: Standard deviation of a pixel from frame to frame; None where pixels cannot be compared.
        fixed_m: Standard deviation of the pixels' means: what averaging over time leaves.
    """

    name: str
    frames: int
    planes: int
    typical: SeenPlane
    temporal_m: float | None = None
    fixed_m: float | None = None


def typical_of(planes: Sequence[SeenPlane]) -> SeenPlane:
    """Return the median of every figure."""
    steps_m = [plane.step_m for plane in planes if plane.step_m is not None]
    return SeenPlane(
        distance_m=median(plane.distance_m for plane in planes),
        tilt_rad=median(plane.tilt_rad for plane in planes),
        measured_ratio=median(plane.measured_ratio for plane in planes),
        raw=_typical_accuracy([plane.raw for plane in planes]),
        filtered=_typical_accuracy([plane.filtered for plane in planes]),
        step_m=median(steps_m) if steps_m else None,
    )


def _typical_accuracy(many: Sequence[Accuracy]) -> Accuracy:
    return Accuracy(**{f.name: median(getattr(one, f.name) for one in many) for f in fields(Accuracy)})


@dataclass(frozen=True, slots=True, eq=False)
class ResidualMap:
    """Errors of the depth over an image.

    Attributes:
        image: (H, W) uint8 grey image.
        error_m: (H, W) depth less that of the plane; NaN where there is none.
        caption: A few words.
    """

    image: Image
    error_m: Array
    caption: str


def check_rgbd(source: Log) -> None:
    """Check that a log has depth images.

    Raises:
        SourceError: It is a LiDAR's.
    """
    if source.sensor != "rgbd":
        raise SourceError(f"{source.path}: a log of scans; this measures depth images, so want an RGB-D log")


def first_frame(source: Log) -> RgbdFrame:
    """Return the first frame of a log that can be read.

    Raises:
        SourceError: None can, or they are scans.
    """
    check_rgbd(source)
    reason = "it has no frames"
    for entry in source.entries():
        try:
            return depth_frame(entry)
        except FrameError as error:
            reason = str(error)
    raise SourceError(f"{source.path}: no frame can be read; the last: {reason}")


def depth_frame(entry: FrameRef) -> RgbdFrame:
    """Load a frame with its depth.

    Raises:
        FrameError: It has none, or cannot be read.
    """
    frame = entry.load(colour=False)
    if not isinstance(frame, RgbdFrame):
        raise FrameError(f"frame {entry.stamp_ns}: a scan, not a depth image")
    return frame
