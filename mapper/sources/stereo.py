"""Stereo pairs as frames with depth: rectified as they are read, and matched where depth is asked for."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage, Image
from mapper.core.geometry import Transform, inverse, nearest_rotation, spread_indices, transform
from mapper.sensing.config import DepthNoiseConfig
from mapper.sensing.stereo import LEAST_DISPARITY_PX, stereo_depth_m, stereo_noise
from mapper.sources.calibration import Calibration
from mapper.sources.config import CameraConfig
from mapper.sources.image_files.decoded import SATURATED, DecodedColour, DecodedDepth
from mapper.sources.image_files.image_sizes import Size
from mapper.sources.image_files.reading import TUM_UNITS_PER_M

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]
"""(H, W) columns and rows in a recorded image of the rectified one's pixels, for ``cv2.remap``."""
ReadImage = Callable[[bool], Image]
"""Reads an image, in colour or grey."""
_PAIRS_LOOKED_AT, _MATCHED_SHARE, _EXCHANGED_RATIO = 3, 1 / 3, 1.5
"""Of three real logs' pixels 52 to 82 % match, and if left and right are exchanged 13 to 30 %."""


@dataclass(frozen=True, slots=True, eq=False)
class StereoCamera:
    """Two cameras side by side, whose rectified images have the same rows; frames are the left one's.

    Attributes:
        calibration: Camera of both rectified images, without distortion.
        baseline_m: Distance of the right camera along x.
        size_px: Size of the images as recorded.
        T_left_rectified: (4, 4) pose of the rectified left camera in the left camera's frame: a rotation.
        maps: Of the left and the right image; None where the recorded ones are rectified.
    """

    calibration: Calibration
    baseline_m: float
    size_px: Size
    T_left_rectified: Transform
    maps: tuple[Maps, Maps] | None = None

    @property
    def noise(self) -> DepthNoiseConfig:
        """Noise of the depth."""
        return stereo_noise(self._focal_baseline_px_m)

    @property
    def units_per_m(self) -> float:
        """Units of a metre in which the farthest depth fits into 16 bits."""
        return min(TUM_UNITS_PER_M, float(SATURATED * LEAST_DISPARITY_PX // self._focal_baseline_px_m))

    @property
    def note(self) -> str:
        """Sentence on how depth is made."""
        at_m = 2.0
        sigma_mm = 1e3 * self.noise.quadratic_per_m * at_m**2
        return (
            "depth is that of stereo pairs, matched as they are read: baseline "
            f"{1e3 * self.baseline_m:.1f} mm, focal length {self.calibration.fx_px:.1f} px, noise "
            f"{sigma_mm:.0f} mm at {at_m:g} m"
        )

    def image_of(self, read_left: ReadImage, where: object) -> DecodedColour:
        """Return the left image of a frame, not read yet."""
        return DecodedColour(where, lambda in_colour: self._rectify(read_left(in_colour), 0, where))

    def depth_of(self, read_left: ReadImage, read_right: ReadImage, where: object) -> DecodedDepth:
        """Return the depth of a frame, not read yet."""
        return DecodedDepth(where, partial(self._depth_m, read_left, read_right, where), self.units_per_m)

    def refuse_exchanged(
        self, pair_at: Callable[[int], Sequence[ReadImage]], count: int, where: object
    ) -> None:
        """Refuse a log whose images match only if the right one is taken for the left one.

        Args:
            pair_at: Returns the left and the right image of frame 0 … count − 1.
            count: Number of frames.
            where: What an error names.

        Raises:
            SourceError: Left and right have changed places.
        """
        shares = []
        for index in spread_indices(count, _PAIRS_LOOKED_AT).tolist():
            with suppress(FrameError):
                left, right = (self._rectify(read(False), k, where) for k, read in enumerate(pair_at(index)))
                depths_m = (
                    stereo_depth_m(*one, focal_baseline_px_m=1.0) for one in ((left, right), (right, left))
                )
                shares.append([(depth_m > 0.0).mean() for depth_m in depths_m])
        matched, exchanged = np.median(shares, axis=0) if shares else (0.0, 0.0)
        if exchanged > max(_MATCHED_SHARE, _EXCHANGED_RATIO * matched):
            raise SourceError(
                f"{where}: left and right have changed places: {exchanged:.0%} of the pixels match if the "
                f"images are exchanged, {matched:.0%} as they are; exchange the folders' names, or in a "
                "recording set source.topics.color to the topic that is called right"
            )

    @property
    def _focal_baseline_px_m(self) -> float:
        return self.calibration.fx_px * self.baseline_m

    def _depth_m(self, read_left: ReadImage, read_right: ReadImage, where: object) -> DepthImage:
        left, right = (self._rectify(read(False), k, where) for k, read in enumerate((read_left, read_right)))
        return stereo_depth_m(left, right, focal_baseline_px_m=self._focal_baseline_px_m)

    def _rectify(self, recorded: Image, side: int, where: object) -> Image:
        height_px, width_px = recorded.shape[:2]
        if (width_px, height_px) != self.size_px:
            want = f"{self.size_px[0]}×{self.size_px[1]}"
            raise FrameError(f"{where}: {width_px}×{height_px} px, but the other images have {want}")
        return recorded if self.maps is None else cv2.remap(recorded, *self.maps[side], cv2.INTER_LINEAR)


def refuse_settings(camera: CameraConfig | None) -> None:
    """Refuse settings of one camera for a pair, whose two cameras and their distance belong together.

    Raises:
        SourceError: There are some.
    """
    if camera is not None:
        raise SourceError(
            "source.camera: the cameras of stereo pairs are those that the log states; leave it out, and "
            "correct the log's own calibration files"
        )


def rectified_pair(calibration: Calibration, baseline_m: float, size_px: Size) -> StereoCamera:
    """Return the camera of images that were rectified before they were recorded.

    Raises:
        SourceError: The right camera does not lie to the right of the left one.
    """
    if not baseline_m > 0.0:
        raise SourceError(
            f"{calibration.origin}: the right camera is {baseline_m:g} m to the right of the left one; want "
            "> 0: have left and right changed places?"
        )
    return StereoCamera(calibration, baseline_m, size_px, np.eye(4))


def rectify(left: Calibration, right: Calibration, T_left_right: Transform, size_px: Size) -> StereoCamera:
    """Return the camera of raw images, which are rectified as they are read (Fusiello et al. 2000).

    Args:
        left: Camera of the left images.
        right: Camera of the right images.
        T_left_right: (4, 4) its pose in the left camera's frame.
        size_px: Size of both as recorded.

    Raises:
        SourceError: A calibration is of another size or not in order, one lens is a fisheye and the other
            not, or the cameras do not lie side by side.
    """
    width_px, height_px = size_px
    cameras = [one.camera(width_px=width_px, height_px=height_px) for one in (left, right)]
    is_fisheye = [one.lens is not None and one.lens.is_fisheye for one in (left, right)]
    if is_fisheye[0] != is_fisheye[1]:
        raise SourceError(f"{left.origin}, {right.origin}: one lens is a fisheye, the other is not")
    coefficients = [
        np.array(one.distortion if one.lens is None else one.lens.coefficients) for one in (left, right)
    ]
    T_right_left = inverse(T_left_right)
    K, D = [camera.matrix for camera in cameras], coefficients
    R, t = np.ascontiguousarray(T_right_left[:3, :3]), T_right_left[:3, 3:].copy()
    if abs(T_left_right[0, 3]) < np.abs(T_left_right[1:3, 3]).max() or T_left_right[0, 3] <= 0.0:
        x, y, z = T_left_right[:3, 3]
        raise SourceError(
            f"{right.origin}: the right camera lies at x {x:.3g}, y {y:.3g}, z {z:.3g} m of the left one, "
            f"{left.origin}; want it to the right, x > 0"
        )
    model: Any = cv2.fisheye if is_fisheye[0] else cv2
    cropped = {"balance": 0.0} if is_fisheye[0] else {"alpha": 0.0}
    R_left, R_right, P, *_ = model.stereoRectify(
        K[0], D[0], K[1], D[1], size_px, R, t, flags=cv2.CALIB_ZERO_DISPARITY, **cropped
    )
    matrix = np.asarray(P)[:3, :3]
    maps = [
        model.initUndistortRectifyMap(K[side], D[side], R_side, matrix, size_px, cv2.CV_32FC1)
        for side, R_side in enumerate((R_left, R_right))
    ]
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    calibration = Calibration(f"{left.origin}, rectified", fx, fy, cx, cy, size_px=size_px)
    T_left_rectified = transform(nearest_rotation(np.asarray(R_left).T), np.zeros(3))
    baseline_m = float(np.linalg.norm(t))
    return StereoCamera(calibration, baseline_m, size_px, T_left_rectified, (maps[0], maps[1]))
