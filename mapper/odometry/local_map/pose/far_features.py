"""Rotation of the camera by features of unknown depth: those beyond the depth sensor's reach.

They are points whose inverse depth has nothing but a prior (Civera, Davison & Montiel 2008). The translation
is known no better than predicted, so they determine the rotation alone.
"""

import numpy as np

from mapper.core.geometry import Array, Points, Transform, apply, inverse, transform
from mapper.odometry.local_map.landmarks.ray_uncertainty import ray_slope
from mapper.odometry.local_map.observation.image_observation import ImageObservation, back_projected
from mapper.odometry.local_map.pose.local_search import LocalSearch, PredictedFeatures
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose, project
from mapper.registration.reprojection import refine_pose

_REACHES = 2.0
"""Expected depth, in those of the farthest feature with depth. The inverse depth errs by as much as it is."""
_FEWEST, _LEAST_RATIO = 50, 0.5
"""Features that have to agree on a rotation, in number and as a share of those that match: without depth are
some at edges near by, too."""
_SEARCH_PX = 30.0
"""Radius of the search about predicted pixels: a turn that begins or ends moves features that far."""
_MAX_RATIO = 0.8
_ROUNDS, _ITERATIONS = 3, 8
_INFINITY = 1e9


def turned_by_far_features(
    search: LocalSearch,
    observation: ImageObservation,
    last: TrackedPose,
    T_camera_world: Transform,
    *,
    sigma_m: float,
) -> Transform:
    """Return a predicted pose, turned as the last frame's features without depth show; itself if few do.

    Args:
        search: Matches features.
        observation: The frame.
        last: The frame before it.
        T_camera_world: (4, 4) predicted pose of the frame.
        sigma_m: Standard deviation of its translation.
    """
    before, intrinsics = last.observation, observation.intrinsics
    is_far = ~before.has_depth
    is_far[last.moving] = False
    far = np.flatnonzero(is_far)
    if len(far) < _FEWEST or not before.has_depth.any():
        return T_camera_world
    reach_m = _REACHES * float(np.nanmax(before.depth_m))
    points_camera = back_projected(before.measured[far, :2], np.full(len(far), reach_m), intrinsics)
    points_world = apply(inverse(last.T_camera_world), points_camera)
    predicted = PredictedFeatures(
        project(T_camera_world, points_world, intrinsics),
        apply(T_camera_world, points_world)[:, 2],
        before.octave[far],
        before.bits[far],
    )
    feature = search.match_near(
        observation,
        predicted,
        search_px=_SEARCH_PX,
        taken=observation.has_depth,
        max_ratio=_MAX_RATIO,
    )
    hits = np.flatnonzero(feature >= 0)
    if len(hits) < _FEWEST:
        return T_camera_world
    features, points_world = feature[hits], points_world[hits]
    shift_px = _parallax_px(last, T_camera_world, points_world, intrinsics, reach_m)
    variances = 1.0 / observation.weights[features]
    variances[:, :2] += shift_px**2 + (intrinsics[:2] / reach_m * sigma_m) ** 2
    measured = observation.measured[features].copy()
    measured[:, 2] = np.nan
    centre_world = inverse(T_camera_world)[:3, 3]
    directions_world = _INFINITY * (points_world - centre_world)
    T_found, is_inlier, _ = refine_pose(
        T_camera_world, directions_world, measured, 1.0 / variances, intrinsics, _ROUNDS, _ITERATIONS
    )
    if is_inlier.sum() < max(_FEWEST, _LEAST_RATIO * len(hits)):
        return T_camera_world
    R_camera_world = T_found[:3, :3]
    return transform(R_camera_world, -R_camera_world @ centre_world)


def _parallax_px(
    last: TrackedPose, T_camera_world: Transform, points_world: Points, intrinsics: Array, reach_m: float
) -> Array:
    """Return by how much (N, 2) pixels of points shift if their inverse depth is 0 instead."""
    rays_world = points_world - inverse(last.T_camera_world)[:3, 3]
    slope_px: Array = ray_slope(T_camera_world, points_world, rays_world, intrinsics)[:, :2]
    return slope_px * reach_m
