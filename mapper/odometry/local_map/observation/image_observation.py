"""Observation of one RGB-D frame: features with depth, as arrays for the compiled kernels."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import Frame, RgbdFrame
from mapper.core.geometry import Array, Points, Transform
from mapper.features.base import Detector
from mapper.features.frame_view import ImageView
from mapper.features.hamming import Bits, pack
from mapper.features.window_matching import FeatureGrid, sort_into_grid
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.observation.depth_surfaces import DepthCells, depth_cells
from mapper.odometry.local_map.observation.pixel_motion import of_middle_row, row_shift
from mapper.places.vocabulary import Vocabulary
from mapper.runtime.archived import Archivable
from mapper.sensing.config import KINECT_NOISE
from mapper.sensing.depth_edges import lies_behind_edge
from mapper.sensing.depth_noise import depth_sigma_m, feature_depth_m, feature_depth_sigma_m

FEW_MOVING = 0.05
"""Share of the features below which nothing moves by itself: depths at edges are mistaken for it."""
_OUTLINE_WEIGHT = 0.01
"""Share of a disparity's weight on outlines: its error is ten times the usual one."""
_SCALE_ERROR = 0.02
"""Error of depths beside the sensor's noise, as a share: its scale, and the slope where a feature lies."""

_NONE = np.empty(0, np.int32)


@dataclass(frozen=True, slots=True, eq=False)
class ImageObservation(Archivable):
    """The features of one frame.

    Attributes:
        stamp_ns: The frame's stamp.
        pixels: (N, 2) undistorted pixels, as they were read.
        depth_m: (N,) as they were read; NaN without depth.
        octave: (N,) int32 pyramid level.
        bits: (N, 4) uint64 descriptors.
        words: (N,) int32 visual words.
        measured: (N, 3) u, v and virtual disparity bf / z in pixels, as a global shutter would have read them
            when the middle row was read; NaN in the third column without depth or if it is not used.
        weights: (N, 3) inverse variances of the three, px⁻².
        sensor_weights: (N, 3) likewise, by the depth sensor's noise where that is smaller than the virtual
            disparity's: for tests of a common motion, without errors of its calibration.
        points_camera: (N, 3) metres, of ``measured``; NaN without depth.
        on_outline: (N,) features close to something nearer, with which they may move.
        grid: Index of the features, which are sorted by its cells.
        intrinsics: (5,) fx, fy, cx, cy, bf in pixels (bf in pixel metres).
        size_px: Image width and height.
        T_body_camera: (4, 4) pose of the camera in the body frame.
        sweep_camera: (6,) motion of the camera while the rows were read, in its own axes (rotation,
            translation), that ``measured`` allows for; 0 for a global shutter.
        image_checksum: Of the image, see :class:`~mapper.core.frames.RgbdFrame`.
        depth_cells: The depth image, reduced; None if it is not aligned.
        grey_cells: (R, C) uint8 mean grey level in each of its cells; None without them.
        depth_delay_s: Time from the frame's stamp to the depth image's.
        unswept: The observation without a motion, which this one is made from; None if that is itself.
    """

    stamp_ns: int
    pixels: Array
    depth_m: Array
    octave: NDArray[np.int32]
    bits: Bits
    words: NDArray[np.int32]
    measured: Array
    weights: Array
    sensor_weights: Array
    points_camera: Points
    on_outline: NDArray[np.bool_]
    grid: FeatureGrid
    intrinsics: Array
    size_px: tuple[int, int]
    T_body_camera: Transform
    sweep_camera: Array
    image_checksum: int | None
    depth_cells: DepthCells | None = None
    grey_cells: NDArray[np.uint8] | None = None
    depth_delay_s: float = 0.0
    unswept: "ImageObservation | None" = None

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def has_depth(self) -> NDArray[np.bool_]:
        """(N,) which features have depth."""
        return ~np.isnan(self.depth_m)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Return what is written of it: the rest follows from that, to the bit."""
        if self.unswept is not None:
            return _swept, (self.unswept, self.sweep_camera)
        measured = {
            field.name: getattr(self, field.name) for field in fields(self) if field.name not in _DERIVED
        }
        return _unswept, (measured, not np.isnan(self.measured[:, 2]).all())

    def reduced_frame(self) -> RgbdFrame | None:
        """Return the whole image and its depth with one pixel for each depth cell; None without them."""
        if self.depth_cells is None or self.grey_cells is None:
            return None
        cells = self.depth_cells
        return RgbdFrame(self.stamp_ns, self.grey_cells, cells.depth_m, cells.reduced_camera)

    def weights_among(self, moved: NDArray[np.bool_]) -> Array:
        """Return the (N, 3) inverse variances for the test which features agree on a motion.

        Args:
            moved: (N,) features that move by themselves. If there are many, depth separates those at rest.
        """
        return self.sensor_weights if moved.sum() > FEW_MOVING * len(self) else self.weights

    def with_disparity_sigma(self, relative: float) -> "ImageObservation":
        """Return the observation with virtual disparities whose error is this share of a pixel's.

        Those on outlines may be of the background: their landmarks are placed by the views of them instead.
        """
        weights = self.weights.copy()
        weights[:, 2] = weights[:, 0] / relative**2
        weights[self.on_outline, 2] *= _OUTLINE_WEIGHT
        return replace(self, weights=weights)

    def mask_of(self, features: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return (N,) which features are among some of them, given by their indices."""
        mask = np.zeros(len(self), np.bool_)
        mask[features] = True
        return mask

    def among_moving(self, moved: NDArray[np.bool_]) -> "ImageObservation":
        """Return the observation as ``weights_among`` weighs it."""
        if self.weights is self.sensor_weights or moved.sum() <= FEW_MOVING * len(self):
            return self
        unswept = None
        if self.unswept is not None:
            unswept = replace(self.unswept, weights=self.unswept.sensor_weights)
        return replace(self, weights=self.sensor_weights, unswept=unswept)

    def swept(self, sweep_camera: Array) -> "ImageObservation":
        """Return the observation with the shift of each row by another motion of the camera taken out."""
        if not (sweep_camera.any() or self.sweep_camera.any()):
            return self
        pixels, z = of_middle_row(self.pixels, self.depth_m, self.intrinsics, self.size_px[1], sweep_camera)
        disparity_px = np.where(np.isnan(self.measured[:, 2]), np.nan, self.intrinsics[4] / z)
        return replace(
            self,
            measured=np.column_stack([pixels, disparity_px]),
            points_camera=back_projected(pixels, z, self.intrinsics),
            sweep_camera=sweep_camera,
            unswept=self if self.unswept is None else self.unswept,
        )

    def row_shift(self, pixels: Array, depth_m: Array, sweep_camera: Array | None = None) -> Array:
        """Return by how much (N, 2) pixels shift until their row is read, from the middle row on."""
        sweep_camera = self.sweep_camera if sweep_camera is None else sweep_camera
        return row_shift(pixels, depth_m, self.intrinsics, self.size_px[1], sweep_camera)

    def view(self, moving: NDArray[np.int32] = _NONE) -> ImageView:
        """Return the view for place recognition, without the (M,) features that move by themselves."""
        still = np.delete(np.arange(len(self)), moving)
        return ObservedView(
            stamp_ns=self.stamp_ns,
            pixels=self.measured[still, :2],
            sigma_px=self.weights[still, 0] ** -0.5,
            descriptors=self.bits[still].view(np.uint8).reshape(-1, 32),
            points_camera=self.points_camera[still],
            intrinsics=self.intrinsics[:4],
            T_body_camera=self.T_body_camera,
            observation=self,
            moving=moving,
        )


_DERIVED = frozenset({"measured", "points_camera", "sweep_camera", "unswept"})


@dataclass(frozen=True, slots=True, eq=False)
class ObservedView(ImageView):
    """View of an observation, which it is made from again after it was written.

    Attributes:
        observation: The observation.
        moving: (M,) int32 features of it that are not in the view.
    """

    observation: ImageObservation
    moving: NDArray[np.int32]

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Return what it is made from: a keyframe's observation is in the archive already."""
        return _view_of, (self.observation, self.moving)


def observe_image(
    frame: Frame, detector: Detector, vocabulary: Vocabulary, config: KeyframeOdometryConfig
) -> ImageObservation:
    """Detect features, look up their depth at the raw pixels, and undistort them.

    Raises:
        FrameError: The frame is a bare scan, or the detector's descriptors are not 256 bits.
    """
    if not isinstance(frame, RgbdFrame):
        raise FrameError(
            f"frame {frame.stamp_ns}: odometry '{config.kind}' needs colour and depth images, "
            "got a bare scan; choose another odometry.kind"
        )
    camera = frame.camera
    features = detector.detect(frame.gray)
    if features.descriptors.dtype != np.uint8 or features.descriptors.shape[1] != 32:
        raise FrameError(
            f"odometry '{config.kind}' needs 256-bit descriptors; choose detector 'orb' or 'uniform-orb'"
        )
    pixels = camera.undistort(features.pixels)
    order, grid = sort_into_grid(pixels, width_px=camera.width_px, height_px=camera.height_px)
    pixels, octave = pixels[order], features.octave[order]
    depth_m, column, row = feature_depth_m(frame.depth_m, features.pixels[order])
    if config.max_depth_m is not None:
        depth_m[depth_m > config.max_depth_m] = np.nan
    intrinsics = np.append(camera.intrinsics, config.virtual_baseline_px_m)
    bits = pack(features.descriptors[order])
    sigma_px = detector.scale_factor ** octave.astype(np.float64)
    disparity_sigma_px, sensor_px = _disparity_sigmas_px(frame, depth_m, (column, row), sigma_px, config)
    cells = None
    if config.align_depth:
        cells = depth_cells(frame.depth_m, camera, distortion_per_m=frame.removed_distortion_per_m)
    measured = {
        "stamp_ns": frame.stamp_ns,
        "pixels": pixels,
        "depth_m": depth_m,
        "octave": octave,
        "bits": bits,
        "words": vocabulary.words_of(bits),
        "weights": np.column_stack([sigma_px, sigma_px, disparity_sigma_px]) ** -2.0,
        "sensor_weights": np.column_stack([sigma_px, sigma_px, sensor_px]) ** -2.0,
        "on_outline": lies_behind_edge(frame.depth_m, column, row, sigma_px),
        "grid": grid,
        "intrinsics": intrinsics,
        "size_px": (camera.width_px, camera.height_px),
        "T_body_camera": frame.T_body_camera,
        "image_checksum": frame.image_checksum,
        "depth_cells": cells,
        "grey_cells": None if cells is None else cells.mean_of(frame.gray),
        "depth_delay_s": frame.depth_delay_s,
    }
    return _unswept(measured, config.depth_residual)


def _disparity_sigmas_px(
    frame: RgbdFrame,
    depth_m: Array,
    at: tuple[NDArray[np.intp], NDArray[np.intp]],
    sigma_px: Array,
    config: KeyframeOdometryConfig,
) -> tuple[Array, Array]:
    """Return the (N,) standard deviations of virtual disparities, and by the sensor's noise where smaller."""
    px_per_m, noise = config.virtual_baseline_px_m / depth_m**2, config.depth_noise
    disparity_px = sigma_px * config.disparity_sigma_px
    if noise is not None:
        sigma_m = feature_depth_sigma_m(frame.depth_m, *at, sigma_px=sigma_px, noise=noise)
        # Without depth the weight is not used, but it is a factor in sums.
        disparity_px = np.where(np.isnan(depth_m), disparity_px, px_per_m * sigma_m)
    sensor_m = np.hypot(depth_sigma_m(noise or KINECT_NOISE, depth_m), _SCALE_ERROR * depth_m)
    return disparity_px, np.fmin(px_per_m * sensor_m, disparity_px)


def _unswept(measured: Mapping[str, Any], has_disparity: bool) -> ImageObservation:
    """Return the observation of a camera at rest, with what follows from its measurements."""
    pixels, depth_m, intrinsics = measured["pixels"], measured["depth_m"], measured["intrinsics"]
    disparity_px = intrinsics[4] / depth_m if has_disparity else np.full(len(pixels), np.nan)
    return ImageObservation(
        measured=np.column_stack([pixels, disparity_px]),
        points_camera=back_projected(pixels, depth_m, intrinsics),
        sweep_camera=np.zeros(6),
        **measured,
    )


def _view_of(observation: ImageObservation, moving: NDArray[np.int32]) -> ImageView:
    return observation.view(moving)


def _swept(unswept: ImageObservation, sweep_camera: Array) -> ImageObservation:
    return unswept.swept(sweep_camera)


def back_projected(pixels: Array, depth_m: Array, intrinsics: Array) -> Points:
    """Return the (N, 3) points, camera frame, of undistorted (N, 2) pixels and their depths."""
    rays = (pixels - intrinsics[2:4]) / intrinsics[:2]
    return np.column_stack([rays * depth_m[:, np.newaxis], depth_m])
