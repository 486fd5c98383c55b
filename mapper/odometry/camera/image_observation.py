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
from mapper.odometry.camera.depth_surfaces import DepthCells, depth_cells
from mapper.odometry.camera.pixel_motion import depth_velocity, line_phase, pixel_velocity
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.places.vocabulary import Vocabulary
from mapper.runtime.archived import Archivable
from mapper.sensing.config import KINECT_NOISE
from mapper.sensing.depth import depth_sigma_m, feature_depth_m, feature_depth_sigma_m

_MIN_DEPTH_M = 0.05
_FEW_MOVING = 0.05
"""Share of the features below which nothing moves by itself: depths at edges look like it."""
_SCALE_ERROR = 0.02
"""Error of depths beside the sensor's noise, as a share: its scale, and the slope where a feature lies."""


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
            disparity's: they tell which features move alike, and leave errors of its calibration out.
        points_camera: (N, 3) metres, of ``measured``; NaN without depth.
        grid: Index of the features, which are sorted by its cells.
        intrinsics: (5,) fx, fy, cx, cy, bf in pixels (bf in pixel metres).
        size_px: Image width and height.
        T_body_camera: (4, 4) pose of the camera in the body frame.
        sweep_camera: (6,) motion of the camera while the rows were read, in its own axes (rotation,
            translation), that ``measured`` allows for; 0 for a global shutter.
        depth_cells: The depth image, reduced; None if it is not aligned.
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
    grid: FeatureGrid
    intrinsics: Array
    size_px: tuple[int, int]
    T_body_camera: Transform
    sweep_camera: Array
    depth_cells: DepthCells | None = None
    unswept: "ImageObservation | None" = None

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def has_depth(self) -> NDArray[np.bool_]:
        """(N,) which features have depth."""
        return ~np.isnan(self.depth_m)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a state file holds of it: the rest follows from that, to the bit."""
        if self.unswept is not None:
            return {"unswept": self.unswept, "sweep_camera": self.sweep_camera}
        measured = {
            field.name: getattr(self, field.name) for field in fields(self) if field.name not in _DERIVED
        }
        return {"measured": measured, "has_disparity": not np.isnan(self.measured[:, 2]).all()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make it again of that."""
        if "unswept" in state:
            _copy_fields(state["unswept"].swept(state["sweep_camera"]), self)
        else:
            _copy_fields(_unswept(state["measured"], state["has_disparity"]), self)

    def repeats(self, earlier: "ImageObservation") -> bool:
        """Return whether both are of one image, to the last feature: the camera was frozen, or is slower."""
        return (
            len(self) > 0
            and np.array_equal(self.bits, earlier.bits)
            and np.array_equal(self.pixels, earlier.pixels)
        )

    def weights_among(self, moved: NDArray[np.bool_]) -> Array:
        """Return the (N, 3) inverse variances that tell which features agree on a motion.

        Args:
            moved: (N,) features that move by themselves. Among many of them the depth tells still ones apart.
        """
        return self.sensor_weights if moved.sum() > _FEW_MOVING * len(self) else self.weights

    def swept(self, sweep_camera: Array) -> "ImageObservation":
        """Return the observation with the shift of each line by another motion of the camera taken out."""
        if not (sweep_camera.any() or self.sweep_camera.any()):
            return self
        depth_m = np.where(self.has_depth, self.depth_m, _usual(self.depth_m))
        pixels = self.pixels - self.line_shift(self.pixels, depth_m, sweep_camera)
        phase = line_phase(self.pixels, self.size_px)
        z = self.depth_m - phase * depth_velocity(self.pixels, depth_m, self.intrinsics, sweep_camera)
        z = np.maximum(z, 0.5 * self.depth_m)
        disparity_px = np.where(np.isnan(self.measured[:, 2]), np.nan, self.intrinsics[4] / z)
        return replace(
            self,
            measured=np.column_stack([pixels, disparity_px]),
            points_camera=back_projected(pixels, z, self.intrinsics),
            sweep_camera=sweep_camera,
            unswept=self if self.unswept is None else self.unswept,
        )

    def line_shift(self, pixels: Array, depth_m: Array, sweep_camera: Array | None = None) -> Array:
        """Return by how much (N, 2) pixels shift until their line is read, from the middle one on."""
        depth_m = np.maximum(depth_m, _MIN_DEPTH_M)
        sweep_camera = self.sweep_camera if sweep_camera is None else sweep_camera
        phase = line_phase(pixels, self.size_px)
        shift: Array = phase[:, np.newaxis] * pixel_velocity(pixels, depth_m, self.intrinsics, sweep_camera)
        return shift

    def view(self) -> ImageView:
        """Return the view for place recognition."""
        return ObservedView(
            stamp_ns=self.stamp_ns,
            pixels=self.measured[:, :2],
            sigma_px=self.weights[:, 0] ** -0.5,
            descriptors=self.bits.view(np.uint8).reshape(len(self), 32),
            points_camera=self.points_camera,
            intrinsics=self.intrinsics[:4],
            T_body_camera=self.T_body_camera,
            observation=self,
        )


_DERIVED = frozenset({"measured", "points_camera", "sweep_camera", "unswept"})


@dataclass(frozen=True, slots=True, eq=False)
class ObservedView(ImageView):
    """View of an observation, which it is made from again after it was written.

    Attributes:
        observation: The observation.
    """

    observation: ImageObservation

    def __getstate__(self) -> ImageObservation:
        """Return the observation alone: a keyframe's is in the archive already."""
        return self.observation

    def __setstate__(self, state: ImageObservation) -> None:
        """Make it again of that."""
        _copy_fields(state.view(), self)


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
    intrinsics = np.array(
        [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, config.virtual_baseline_px_m]
    )
    bits = pack(features.descriptors[order])
    sigma_px = detector.scale_factor ** octave.astype(np.float64)
    disparity_sigma_px = sigma_px
    if config.depth_noise is not None:
        sigma_m = feature_depth_sigma_m(
            frame.depth_m, column, row, sigma_px=sigma_px, noise=config.depth_noise
        )
        # Without depth the weight is not used, but it is a factor in sums.
        known_px = config.virtual_baseline_px_m / depth_m**2 * sigma_m
        disparity_sigma_px = np.where(np.isnan(depth_m), disparity_sigma_px, known_px)
    sensor_m = np.hypot(depth_sigma_m(config.depth_noise or KINECT_NOISE, depth_m), _SCALE_ERROR * depth_m)
    sensor_px = np.fmin(config.virtual_baseline_px_m / depth_m**2 * sensor_m, disparity_sigma_px)
    measured = {
        "stamp_ns": frame.stamp_ns,
        "pixels": pixels,
        "depth_m": depth_m,
        "octave": octave,
        "bits": bits,
        "words": vocabulary.words_of(bits),
        "weights": np.column_stack([sigma_px, sigma_px, disparity_sigma_px]) ** -2.0,
        "sensor_weights": np.column_stack([sigma_px, sigma_px, sensor_px]) ** -2.0,
        "grid": grid,
        "intrinsics": intrinsics,
        "size_px": (camera.width_px, camera.height_px),
        "T_body_camera": frame.T_body_camera,
        "depth_cells": depth_cells(frame.depth_m, camera) if config.align_depth else None,
    }
    return _unswept(measured, config.depth_residual)


def _unswept(measured: Mapping[str, Any], has_disparity: bool) -> ImageObservation:
    """Return the observation of a camera that stands still, with what follows from its measurements."""
    pixels, depth_m, intrinsics = measured["pixels"], measured["depth_m"], measured["intrinsics"]
    disparity_px = intrinsics[4] / depth_m if has_disparity else np.full(len(pixels), np.nan)
    return ImageObservation(
        measured=np.column_stack([pixels, disparity_px]),
        points_camera=back_projected(pixels, depth_m, intrinsics),
        sweep_camera=np.zeros(6),
        **measured,
    )


def _copy_fields(made: Any, instance: Any) -> None:
    """Give a frozen object that has no fields yet those of another of its class."""
    for field in fields(made):
        object.__setattr__(instance, field.name, getattr(made, field.name))


def back_projected(pixels: Array, depth_m: Array, intrinsics: Array) -> Points:
    """Return the (N, 3) points, camera frame, of undistorted (N, 2) pixels and their depths."""
    rays = (pixels - intrinsics[2:4]) / intrinsics[:2]
    return np.column_stack([rays * depth_m[:, np.newaxis], depth_m])


def _usual(depth_m: Array) -> float:
    """Return the median depth, for features without; 1 m if none has any."""
    known = depth_m[~np.isnan(depth_m)]
    return float(np.median(known)) if known.size else 1.0
