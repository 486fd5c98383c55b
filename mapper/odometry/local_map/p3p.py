"""Pose from points and pixels alone: P3P inside RANSAC (Zhao et al. 2020, §1.2)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform
from mapper.features.matching import drawing_order

_CONFIDENCE = 0.999


def ransac_p3p(
    points_world: Points,
    pixels: Array,
    intrinsics: Array,
    *,
    tolerance_px: float,
    iterations: int,
    seed: int = 0,
) -> tuple[Transform, NDArray[np.intp]] | None:
    """Return the T_camera_world that most pairs agree with, and which do; None if no four pairs give any.

    Three pairs have up to four solutions (Gao et al. 2003), and a fourth chooses among them.

    Args:
        points_world: (N, 3) metres, N ≥ 4.
        pixels: (N, 2) undistorted pixels that show them.
        intrinsics: (≥ 4,) fx, fy, cx, cy.
        tolerance_px: A pair agrees when its point projects this close to its pixel: β.
        iterations: How many draws at most; fewer once a better one has become unlikely.
        seed: Of the draws; see ``drawing_order``.
    """
    fx, fy, cx, cy = intrinsics[:4]
    order = drawing_order(len(pixels), seed)
    found, rotation, translation, agreeing = cv2.solvePnPRansac(
        points_world[order],
        pixels[order],
        np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        None,
        iterationsCount=iterations,
        reprojectionError=tolerance_px,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or agreeing is None:
        return None
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], _ = cv2.Rodrigues(rotation)
    T_camera_world[:3, 3] = translation[:, 0]
    return T_camera_world, np.sort(order[agreeing[:, 0]])
