"""Observation of one RGB-D frame: features with depth, as arrays for the compiled kernels."""

from dataclasses import dataclass

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
from mapper.places.vocabulary import Vocabulary
from mapper.sensing.depth_noise import feature_depth_m, feature_depth_sigma_m


@dataclass(frozen=True, slots=True, eq=False)
class ImageObservation:
    """The features of one frame.

    Attributes:
        stamp_ns: The frame's stamp.
        pixels: (N, 2) undistorted pixels.
        octave: (N,) int32 pyramid level.
        bits: (N, 4) uint64 descriptors.
        words: (N,) int32 visual words.
        measured: (N, 3) u, v and virtual disparity bf / z in pixels; NaN in the third column without depth
            or if it is not used.
        weights: (N, 3) inverse variances of the three, px⁻².
        points_camera: (N, 3) metres; NaN without depth.
        grid: Index of the features, which are sorted by its cells.
        intrinsics: (5,) fx, fy, cx, cy, bf in pixels (bf in pixel metres).
        size_px: Image width and height.
        T_body_camera: (4, 4) pose of the camera in the body frame.
    """

    stamp_ns: int
    pixels: Array
    octave: NDArray[np.int32]
    bits: Bits
    words: NDArray[np.int32]
    measured: Array
    weights: Array
    points_camera: Points
    grid: FeatureGrid
    intrinsics: Array
    size_px: tuple[int, int]
    T_body_camera: Transform

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def has_depth(self) -> NDArray[np.bool_]:
        """(N,) which features have depth."""
        return ~np.isnan(self.points_camera[:, 2])

    def view(self) -> ImageView:
        """Return the view for place recognition."""
        return ImageView(
            stamp_ns=self.stamp_ns,
            pixels=self.pixels,
            sigma_px=self.weights[:, 0] ** -0.5,
            descriptors=self.bits.view(np.uint8).reshape(len(self), 32),
            points_camera=self.points_camera,
            intrinsics=self.intrinsics[:4],
            T_body_camera=self.T_body_camera,
        )


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
    intrinsics = np.array(
        [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, config.virtual_baseline_px_m]
    )
    disparity_px = config.virtual_baseline_px_m / depth_m
    if not config.depth_residual:
        disparity_px[:] = np.nan
    bits = pack(features.descriptors[order])
    sigma_px = detector.scale_factor ** octave.astype(np.float64)
    disparity_sigma_px = sigma_px * config.disparity_sigma_px
    if config.depth_noise is not None:
        sigma_m = feature_depth_sigma_m(
            frame.depth_m, column, row, sigma_px=sigma_px, noise=config.depth_noise
        )
        # Without depth the weight is not used, but it is a factor in sums.
        known_px = config.virtual_baseline_px_m / depth_m**2 * sigma_m
        disparity_sigma_px = np.where(np.isnan(depth_m), disparity_sigma_px, known_px)
    rays = (pixels - intrinsics[2:4]) / intrinsics[:2]
    return ImageObservation(
        stamp_ns=frame.stamp_ns,
        pixels=pixels,
        octave=octave,
        bits=bits,
        words=vocabulary.words_of(bits),
        measured=np.column_stack([pixels, disparity_px]),
        weights=np.column_stack([sigma_px, sigma_px, disparity_sigma_px]) ** -2.0,
        points_camera=np.column_stack([rays * depth_m[:, None], depth_m]),
        grid=grid,
        intrinsics=intrinsics,
        size_px=(camera.width_px, camera.height_px),
        T_body_camera=frame.T_body_camera,
    )
