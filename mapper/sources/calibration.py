"""Intrinsics of a log, and the cameras of well-known data sets."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import SourceError, listed
from mapper.core.frames import NO_DISTORTION, PinholeCamera
from mapper.core.geometry import Transform, length_and_angle
from mapper.core.rotations import pose_of_row
from mapper.sources.config import CameraConfig
from mapper.sources.lens import Lens

_CHECKED = 17
"""Columns and rows of the pixels whose distortion is taken out to check a calibration."""
_MOST_MOVED = 1000
"""Sides of the image, beyond which a pixel without its distortion is nowhere: the search for it diverged."""

_MOST_UNLIKE = 0.3
"""Pixels are square, and those of analogue video, the least so, 12:11."""
_MOST_OFF_CENTRE = 0.4
"""Principal point's distance from the centre as a share of the side: images are cropped by less."""
_CENTRED = 0.05

Distortion = tuple[float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Intrinsics of a log's images, whose size may not be known before one is read.

    Attributes:
        origin: Source of the calibration, for messages.
        fx_px: Focal length along a row.
        fy_px: Focal length along a column; negative where the camera's y axis points up (ICL-NUIM).
        cx_px: Principal point's column.
        cy_px: Principal point's row.
        distortion: (k1, k2, p1, p2, k3).
        lens: Distortion of another kind, to be taken out of the images when they are read.
        size_px: (width, height) the numbers hold for, if stated.
        depth_units_per_m: Depth image units per metre, if stated.
        depth: Depth camera beside this one, if depth images are its own.
        unread: Names of other files of intrinsics beside the log.
    """

    origin: str
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: Distortion = NO_DISTORTION
    lens: Lens | None = None
    size_px: tuple[int, int] | None = None
    depth_units_per_m: float | None = None
    depth: "DepthCamera | None" = None
    unread: Sequence[str] = ()

    @property
    def needs_depth_pose(self) -> bool:
        """Depth is of a camera of its own, whose pose nothing states."""
        return self.depth is not None and self.depth.T_color_depth is None

    def notes(self) -> list[str]:
        """Return sentences on what is made of the images as they are read."""
        notes = [] if self.depth is None else [self.depth.note]
        if self.unread:
            notes.append(f"intrinsics are read from {self.origin}, and not from {listed(self.unread)}")
        if self.lens is not None:
            notes.append(f"the distortion {self.lens.model} is taken out of the images as they are read")
        return notes

    def with_y_down(self) -> "Calibration":
        """Return the same camera with its y axis mirrored, so that fy is positive."""
        k1, k2, p1, p2, k3 = self.distortion
        return replace(self, fy_px=-self.fy_px, distortion=(k1, k2, -p1, p2, k3))

    def camera(self, *, width_px: int, height_px: int) -> PinholeCamera:
        """Return the camera of images of this size.

        Raises:
            SourceError: The calibration holds for another size, its numbers are not in order, or its
                distortion has no inverse.
        """
        if self.size_px not in (None, (width_px, height_px)):
            width, height = self.size_px or (0, 0)
            settings = "--set source.camera.fx_px=… and so on"
            if width * height_px == height * width_px and self.origin != PRIMESENSE.origin:
                resized = PinholeCamera(
                    width, height, self.fx_px, self.fy_px, self.cx_px, self.cy_px
                ).resized(width_px, height_px)
                names = zip(("fx", "fy", "cx", "cy"), resized.intrinsics, strict=True)
                settings = " ".join(f"--set source.camera.{name}_px={value:.6g}" for name, value in names)
                if any(self.distortion):
                    bent = ",".join(f"{value:g}" for value in self.distortion)
                    settings += f" --set source.camera.distortion=[{bent}]"
                settings = f"if they are resized, {settings}"
            raise SourceError(
                f"{self.origin}: holds for {width}×{height} px, but the images have {width_px}×{height_px}; "
                f"give theirs: {settings}"
            )
        self._refuse_disorder(width_px, height_px)
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        camera = PinholeCamera(width_px, height_px, *numbers, distortion=self.distortion)
        grid = np.meshgrid(np.linspace(0, width_px - 1, _CHECKED), np.linspace(0, height_px - 1, _CHECKED))
        moved = np.abs(camera.undistort(np.stack(grid, axis=2).reshape(-1, 2)))
        if not (moved <= _MOST_MOVED * max(width_px, height_px)).all():
            numbers_text = ", ".join(f"{number:g}" for number in self.distortion)
            raise SourceError(f"{self.origin}: distortion {numbers_text} cannot be taken out of the images")
        return camera

    def _refuse_disorder(self, width_px: int, height_px: int) -> None:
        """Refuse numbers that no camera has, naming those that seem to have changed places."""
        fx, fy, cx, cy = abs(self.fx_px), abs(self.fy_px), self.cx_px, self.cy_px
        off, swapped = (
            [abs((x + 0.5) / width_px - 0.5), abs((y + 0.5) / height_px - 0.5)]
            for x, y in ((cx, cy), (cy, cx))
        )
        if abs(fy - fx) > _MOST_UNLIKE * fx:
            found = "fy and cx" if abs(cx - fx) <= _MOST_UNLIKE * fx else "the focal lengths"
        elif max(off) > _MOST_OFF_CENTRE:
            found = "the principal point"
        elif max(swapped) < _CENTRED < min(off):
            found = "cx and cy"
        else:
            return
        what = "have changed places" if " and " in found else "cannot be right"
        raise SourceError(
            f"{self.origin}: fx {self.fx_px:g}, fy {self.fy_px:g}, cx {cx:g}, cy {cy:g} px for images of "
            f"{width_px}×{height_px} px: {found} {what}; want the order fx fy cx cy, and their size"
        )


@dataclass(frozen=True, slots=True, eq=False)
class DepthCamera:
    """Depth camera beside a colour camera.

    Attributes:
        calibration: Its intrinsics.
        T_color_depth: (4, 4) its pose in the colour camera's frame; None until it is estimated from the log.
        origin: Source of the pose, for messages; of an unknown one, why depth is not colour's.
        tangents: (H, W, 2) x/z and y/z of every pixel's ray where the log states these, and the intrinsics
            are about theirs.
    """

    calibration: Calibration
    T_color_depth: Transform | None
    origin: str
    tangents: NDArray[np.float32] | None = None

    @property
    def note(self) -> str:
        """Sentence on the pose."""
        T_color_depth = np.eye(4) if self.T_color_depth is None else self.T_color_depth
        apart_m, turned_rad = length_and_angle(T_color_depth)
        return (
            f"depth is registered to colour as it is read: its camera, of focal length "
            f"{self.calibration.fx_px:.1f} px, is {1e3 * apart_m:.1f} mm from colour's and turned by "
            f"{np.degrees(turned_rad):.2f}° ({self.origin})"
        )


def configured(camera: CameraConfig | None) -> Calibration | None:
    """Return the intrinsics that a configuration sets; None if it sets none."""
    if camera is None or camera.intrinsics_px is None:
        return None
    return Calibration("source.camera", *camera.intrinsics_px, distortion=camera.distortion)


def configured_depth_intrinsics(camera: CameraConfig | None) -> Calibration | None:
    """Return the depth camera's intrinsics that a configuration sets; None if it sets none."""
    if camera is None or camera.depth_intrinsics_px is None:
        return None
    numbers = camera.depth_intrinsics_px
    return Calibration("source.camera.depth_intrinsics_px", *numbers, distortion=camera.depth_distortion)


def configured_depth_pose(camera: CameraConfig | None) -> Transform | None:
    """Return T_color_depth that a configuration sets; None if it sets none."""
    if camera is None or camera.depth_in_color is None:
        return None
    return pose_of_row(np.array(camera.depth_in_color))


_VGA = (640, 480)
# https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats (Sturm et al. 2012)
FREIBURG = {
    "1": Calibration(
        "camera of TUM freiburg1",
        *(517.306408, 516.469215, 318.643040, 255.313989),
        distortion=(0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
        size_px=_VGA,
    ),
    "2": Calibration(
        "camera of TUM freiburg2",
        *(520.908620, 521.007327, 325.141442, 249.701764),
        distortion=(0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
        size_px=_VGA,
    ),
    "3": Calibration("camera of TUM freiburg3", 535.4, 539.2, 320.1, 247.6, size_px=_VGA),
}
SEVEN_SCENES = Calibration("camera of 7-Scenes", 585.0, 585.0, 320.0, 240.0, size_px=_VGA)
# https://www.doc.ic.ac.uk/~ahanda/VaFRIC/codes.html (Handa et al. 2014)
ICL_NUIM = Calibration("camera of ICL-NUIM", 481.2, -480.0, 319.5, 239.5, size_px=_VGA)
PRIMESENSE = Calibration("PrimeSense's nominal camera", 525.0, 525.0, 319.5, 239.5, size_px=_VGA)

_FREIBURG_NAME = re.compile(r"(?:^|[^a-z])(?:freiburg|fr)([123])(?!\d)", re.IGNORECASE)


def freiburg_camera(*names: str) -> Calibration | None:
    """Return the camera of the first name that contains freiburg1, 2 or 3, or fr1_, fr2_ or fr3_."""
    for name in names:
        if found := _FREIBURG_NAME.search(name):
            return FREIBURG[found[1]]
    return None
