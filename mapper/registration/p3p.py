"""Camera pose from 3D–2D pairs without a first guess: P3P inside RANSAC (Zhao et al. 2020, §1.2)."""

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
    """Return the T_camera_world with most inlier pairs, and their indices; None if no four pairs give a pose.

    Three pairs have up to four solutions (Gao et al. 2003); a fourth pair chooses among them.

    Args:
        points_world: (N, 3) metres, N ≥ 4.
        pixels: (N, 2) their undistorted pixels.
        intrinsics: (≥ 4,) fx, fy, cx, cy.
        tolerance_px: A pair is an inlier when its point projects this close to its pixel (β in the paper).
        iterations: Largest number of draws; fewer once a better one has become unlikely.
        seed: Seed of the draws; see ``drawing_order``.
    """
    fx, fy, cx, cy = intrinsics[:4]
    order = drawing_order(len(pixels), seed)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points_world[order],
        pixels[order],
        np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        None,
        iterationsCount=iterations,
        reprojectionError=tolerance_px,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or inliers is None:
        return None
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], _ = cv2.Rodrigues(rotation)
    T_camera_world[:3, 3] = translation[:, 0]
    return T_camera_world, np.sort(order[inliers[:, 0]])
