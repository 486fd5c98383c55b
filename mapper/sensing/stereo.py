"""Depth of rectified stereo pairs by semi-global matching (Hirschmüller 2008), in OpenCV's implementation."""

import cv2
import numpy as np

from mapper.core.frames import DepthImage, Image
from mapper.sensing.config import DepthNoiseConfig

LEAST_DISPARITY_PX = 1.0
"""Disparities below it say little more than that something is far: their error is half of them."""
_DISPARITY_SIGMA_PX = 0.3
"""0.24 to 0.29 px within surfaces of fr1_xyz seen by a made right camera, whatever the settings below."""
_UNITS_PER_PX = 16.0  # of OpenCV's disparities
_DISPARITIES = 16  # their number is a multiple of it
_WIDTH_SHARE = 6
"""The largest disparity as a part of the width: 0.4 m from EuRoC's cameras, 1.9 m from KITTI's. As many
columns at the left have no depth: the right camera does not see all that is there."""
_BLOCK_PX = 5
_SMALL_STEP, _LARGE_STEP = 8 * _BLOCK_PX**2, 32 * _BLOCK_PX**2
_UNIQUE_PERCENT, _LEFT_RIGHT_PX, _SPECKLE_PX, _SPECKLE_STEP_PX = 10, 1, 100, 1
_GRADIENT_CAP = 63
"""Penalties and filters as OpenCV's documentation recommends them."""


def stereo_depth_m(left: Image, right: Image, *, focal_baseline_px_m: float) -> DepthImage:
    """Return (H, W) float32 depth of the left image's pixels, metres; 0 where nothing was matched.

    Args:
        left: (H, W) uint8 rectified grey image.
        right: (H, W) uint8 of the right camera: points lie in the same row, further left.
        focal_baseline_px_m: Focal length in pixels times the baseline in metres.
    """
    most = -(-left.shape[1] // (_WIDTH_SHARE * _DISPARITIES)) * _DISPARITIES
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=most,
        blockSize=_BLOCK_PX,
        P1=_SMALL_STEP,
        P2=_LARGE_STEP,
        disp12MaxDiff=_LEFT_RIGHT_PX,
        preFilterCap=_GRADIENT_CAP,
        uniquenessRatio=_UNIQUE_PERCENT,
        speckleWindowSize=_SPECKLE_PX,
        speckleRange=_SPECKLE_STEP_PX,
        mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )
    disparity_px = matcher.compute(left, right).astype(np.float32) / np.float32(_UNITS_PER_PX)
    disparity_px[disparity_px < LEAST_DISPARITY_PX] = np.inf
    depth_m: DepthImage = np.float32(focal_baseline_px_m) / disparity_px
    return depth_m


def stereo_noise(focal_baseline_px_m: float) -> DepthNoiseConfig:
    """Return the noise of a pair's depth, σ_z = z² · σ_disparity / (f·b)."""
    return DepthNoiseConfig(quadratic_per_m=_DISPARITY_SIGMA_PX / focal_baseline_px_m)
