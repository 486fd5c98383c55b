"""Hybrid photometric and geometric registration of two RGB-D images (Park, Zhou & Koltun 2017), by Open3D."""

from typing import Any

import cv2
import numpy as np

from mapper.core.frames import NO_DISTORTION, RgbdFrame, undistortion_maps
from mapper.core.geometry import Transform, inverse, nearest_rotation, transform
from mapper.registration.base import Alignment, failed
from mapper.runtime.extras import extra

with extra("peers", "hybrid RGB-D registration"):
    import open3d

_O3D: Any = open3d  # its stubs lack buffers
_MIN_PAIRS = 100
_DECIMALS = 10  # Open3D sums in the order its threads finish: the last digits vary


class HybridRgbd:
    """Hybrid RGB-D registration: frames are aligned by their grey values and depths, from a guess.

    Open3D's own iterations and thresholds are kept. It has no lens model, so images are undistorted first.
    """

    def __init__(self, target: RgbdFrame, *, max_depth_m: float = 4.0) -> None:
        """Bind the method to a target.

        Args:
            target: Frame that stays.
            max_depth_m: Deeper measurements are dropped.
        """
        self._target = _image(target)
        self._option = _O3D.pipelines.odometry.OdometryOption(depth_max=max_depth_m)
        self._jacobian = _O3D.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm()

    def align(self, source: RgbdFrame, T_target_source: Transform) -> Alignment:
        """Return the motion refined from a guess, between frames of one camera.

        Open3D returns neither residual nor share of inliers, only the number of paired pixels: the residual
        is NaN, and the ratio is that of all pixels with depth.
        """
        camera, T_body_camera = source.camera, source.T_body_camera
        intrinsics = _O3D.camera.PinholeCameraIntrinsic(
            camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
        )
        found, T_found, information = _O3D.pipelines.odometry.compute_rgbd_odometry(
            _image(source),
            self._target,
            intrinsics,
            inverse(T_body_camera) @ T_target_source @ T_body_camera,
            self._jacobian,
            self._option,
        )
        pairs = round(float(information[5, 5]))  # Σ GᵀG, where G ends in the identity
        if pairs < _MIN_PAIRS:  # Open3D calls that a success
            return failed(f"{pairs} pixels agree, fewer than {_MIN_PAIRS}")
        if not found or not np.isfinite(T_found).all():
            return failed(f"Open3D could not solve for the motion between {pairs} pixels")
        T_found = np.round(T_found, _DECIMALS)
        T_camera = transform(nearest_rotation(T_found[:3, :3]), T_found[:3, 3])
        return Alignment(
            T_body_camera @ T_camera @ inverse(T_body_camera),
            converged=True,
            inlier_ratio=pairs / max(int(np.count_nonzero(source.depth_m)), pairs, 1),
            inlier_rmse_m=float("nan"),
            pairs=pairs,
        )


def _image(frame: RgbdFrame) -> Any:
    gray, depth_m = frame.gray, frame.depth_m
    if frame.camera.distortion != NO_DISTORTION:
        columns, rows = undistortion_maps(frame.camera)
        gray = cv2.remap(gray, columns, rows, cv2.INTER_LINEAR)
        depth_m = cv2.remap(depth_m, columns, rows, cv2.INTER_NEAREST)  # which mixes no depths across an edge
    return _O3D.geometry.RGBDImage.create_from_color_and_depth(
        _O3D.geometry.Image(np.ascontiguousarray(gray)),
        _O3D.geometry.Image(np.ascontiguousarray(depth_m)),
        depth_scale=1.0,
        depth_trunc=np.inf,
        convert_rgb_to_intensity=True,
    )
