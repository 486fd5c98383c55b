"""Pose of a depth camera beside the colour camera, estimated where a log does not state it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage, Image, PinholeCamera, undistortion_maps
from mapper.core.geometry import Array, Points, Transform, apply, exp, spread_indices, stride_for
from mapper.sources.calibration import Calibration
from mapper.sources.depth_outlines import OUTLINE_STEP, SOUND_SCORE
from mapper.sources.image_files.image_sizes import RecordedCamera, depth_rays

_MOST_FRAMES = 40
"""Frames, spread over the log, that are read: an error of 1 to 2 px where 16 leave 1 to 3."""
_FEWEST_FRAMES, _FEWEST_POINTS, _MOST_POINTS = 8, 200, 1000
_BLURS = (4.0 / 640, 2.0 / 640, 1.0 / 640)
"""Standard deviations of the images' blur, from coarse to fine, as shares of their width."""
_PRIOR_SIGMAS = np.array([*np.radians([4.0, 0.7, 0.7]), 0.06, 0.004, 0.004])
"""Rotation and translation of cameras in one row, parallel but for a tilt (6° in an Azure Kinect)."""
_PRIOR_COST = 0.02
"""Score that a standard deviation costs; 0.03 and 0.01 serve as well."""
_FIRST_X_M, _FIRST_TILT_RAD = np.linspace(-0.12, 0.12, 25), np.radians(np.linspace(-9.0, 9.0, 25))
_STEPS = np.array([0.004, 0.004, 0.004, 0.01, 0.003, 0.003])
_LEAST_DEVIATION = np.float32(1e-6)
_AT_M, _MOST_APART_PX = 1.5, 4.0
"""Distance at which the poses of both halves of the frames are compared, and their largest difference."""

_Pixels = NDArray[np.float32]


def with_depth_pose(
    calibration: Calibration,
    recorded: RecordedCamera,
    read_pair: Callable[[int], tuple[Image, DepthImage]],
    frames: int,
    *,
    where: str,
) -> Calibration:
    """Return the calibration with the pose of its depth camera, by outlines in depth and edges in images.

    Outlines of what stands before something else are edges of brightness too. The score of a pose is the
    gradient of brightness at their projections, in standard deviations from the mean gradient of an image.

    Args:
        calibration: Colour camera, with a depth camera of unknown pose.
        recorded: Camera of the colour images, and the size of the depth images.
        read_pair: Reads a frame's brightness, as the camera sees it, and its depth as recorded, metres.
            Frames for which it raises FrameError are left out.
        frames: Number of frames.
        where: Name of the log in an error.

    Raises:
        SourceError: Too few frames have outlines, or these do not tell the pose.
    """
    assert calibration.depth is not None
    rays = depth_rays(calibration.depth, recorded.depth_px)
    found = list(_outlined(read_pair, spread_indices(frames, _MOST_FRAMES).tolist(), recorded.camera, rays))
    why = f"{len(found)} of its frames have some, want {_FEWEST_FRAMES}"
    if len(found) >= _FEWEST_FRAMES:
        estimate = _estimate(found, recorded.camera)
        apart = f"two halves of the log differ by {estimate.apart_px:.1f} px at {_AT_M} m"
        if estimate.score >= SOUND_SCORE and estimate.apart_px <= _MOST_APART_PX:
            origin = f"estimated by outlines in {len(found)} frames, as the log states none; {apart}"
            T_color_depth = _pose_of(estimate.numbers)
            return replace(
                calibration, depth=replace(calibration.depth, T_color_depth=T_color_depth, origin=origin)
            )
        why = (
            f"at the best pose the gradient of brightness at them is {estimate.score:.2f} standard "
            f"deviations above its mean, want {SOUND_SCORE}, and {apart}, want {_MOST_APART_PX}"
        )
    raise SourceError(
        f"{where}: {calibration.depth.origin}; the log does not say where its camera is, and outlines in "
        f"depth do not tell it: {why}; record /tf_static too, or "
        "--set source.camera.depth_in_color=[x,y,z,qx,qy,qz,qw]"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """Rotation vector and translation of T_color_depth, its score, and how far two halves differ."""

    numbers: Array
    score: float
    apart_px: float


def _estimate(frames: Sequence["_Outlined"], camera: PinholeCamera) -> _Estimate:
    coarse, *finer = _BLURS
    alignment = _Alignment(frames, camera, coarse)
    tried = product(_FIRST_TILT_RAD, _FIRST_X_M)
    starts = [np.array([tilt_rad, 0.0, 0.0, x_m, 0.0, 0.0]) for tilt_rad, x_m in tried]
    numbers = alignment.refine(min(starts, key=alignment.cost))
    for blur in finer:
        alignment = _Alignment(frames, camera, blur)
        numbers = alignment.refine(numbers)
    first, second = (_Alignment(frames[k::2], camera, finer[-1]).refine(numbers) for k in (0, 1))
    return _Estimate(numbers, alignment.score(numbers), _distance_px(first, second, camera))


@dataclass(frozen=True, slots=True, eq=False)
class _Outlined:
    """Undistorted brightness of a frame, and (N, 3) points of outlines in its depth, depth camera's frame."""

    grey: Image
    points_depth: Points


def _outlined(
    read_pair: Callable[[int], tuple[Image, DepthImage]],
    indices: Sequence[int],
    camera: PinholeCamera,
    rays: NDArray[np.float32],
) -> Iterator[_Outlined]:
    """Yield the frames that have outlines; a point is the last of the nearer surface."""
    undistorted = undistortion_maps(camera)
    for index in indices:
        with suppress(FrameError):
            grey, depth_m = read_pair(index)
            grey = cv2.remap(grey, *undistorted, cv2.INTER_LINEAR)
            nearest_m = np.where(depth_m > 0.0, depth_m, np.float32(np.inf))
            is_before = cv2.dilate(depth_m, np.ones((3, 3), np.uint8)) > OUTLINE_STEP * nearest_m
            rows, columns = np.nonzero(is_before)
            if len(rows) >= _FEWEST_POINTS:
                kept = slice(None, None, stride_for(len(rows), _MOST_POINTS))
                rows, columns = rows[kept], columns[kept]
                z = depth_m[rows, columns].astype(np.float64)
                yield _Outlined(grey, np.column_stack([rays[rows, columns] * z[:, np.newaxis], z]))


class _Alignment:
    """Agreement of outlines in depth with edges in images that are blurred."""

    def __init__(self, frames: Sequence[_Outlined], camera: PinholeCamera, blur: float) -> None:
        self._camera = camera
        self._gradients = [_gradient(frame.grey, blur * camera.width_px) for frame in frames]
        self._points_depth = np.concatenate([frame.points_depth for frame in frames])
        self._ends = np.cumsum([len(frame.points_depth) for frame in frames])[:-1]

    def score(self, numbers: Array) -> float:
        """Return the mean gradient at the outlines by a rotation vector and translation of T_color_depth."""
        pixels = self._camera.project(apply(_pose_of(numbers), self._points_depth)).astype(np.float32)
        found = [
            cv2.remap(gradient, at[:, np.newaxis], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            for gradient, at in zip(self._gradients, np.split(pixels, self._ends), strict=True)
        ]
        return float(np.concatenate(found).mean(dtype=np.float64))

    def cost(self, numbers: Array) -> float:
        """Return how bad a pose is, by its score and by what cameras are built like."""
        return _PRIOR_COST * float(((numbers / _PRIOR_SIGMAS) ** 2).sum()) - self.score(numbers)

    def refine(self, numbers: Array) -> Array:
        """Return the best pose around one."""
        from scipy.optimize import minimize

        found = minimize(
            lambda steps: self.cost(steps * _STEPS),
            numbers / _STEPS,
            method="Powell",
            options={"xtol": 0.05, "ftol": 1e-5, "maxiter": 20},
        )
        refined: Array = found.x * _STEPS
        return refined


def _gradient(grey: Image, blur_px: float) -> _Pixels:
    """Return the gradient of brightness in standard deviations from its mean, the strongest 5 % alike."""
    blurred = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), blur_px)
    gradient = np.hypot(cv2.Sobel(blurred, cv2.CV_32F, 1, 0), cv2.Sobel(blurred, cv2.CV_32F, 0, 1))
    gradient = np.minimum(gradient, np.float32(np.percentile(gradient, 95.0)))
    standardised: _Pixels = (gradient - gradient.mean()) / max(gradient.std(), _LEAST_DEVIATION)
    return standardised


def _pose_of(numbers: Array) -> Transform:
    return exp(numbers[:3], numbers[3:])


def _distance_px(one: Array, other: Array, camera: PinholeCamera) -> float:
    """Return the root mean square distance of what two poses project, over the image at one distance."""
    columns, rows = np.meshgrid(
        np.linspace(0.0, camera.width_px - 1.0, 5), np.linspace(0.0, camera.height_px - 1.0, 5)
    )
    tangents = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    points = _AT_M * np.column_stack([tangents, np.ones(len(tangents))])
    pixels = [camera.project(apply(_pose_of(numbers), points)) for numbers in (one, other)]
    return float(np.sqrt(((pixels[0] - pixels[1]) ** 2).sum(axis=1).mean()))
