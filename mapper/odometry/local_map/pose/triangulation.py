"""Triangulation: landmarks from features without depth that keyframes share."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, apply, inverse
from mapper.core.linear import turned
from mapper.features.hamming import Bits, hamming
from mapper.features.window_matching import assign
from mapper.odometry.local_map.landmarks.landmark_kernels import MIN_DEPTH_M
from mapper.odometry.local_map.landmarks.landmark_map import MIN_SHARED_LANDMARKS, Ids, LandmarkMap
from mapper.odometry.local_map.landmarks.ray_uncertainty import ray_slope
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.pose.pose_tracker import MAX_HAMMING, TrackedPose
from mapper.registration.reprojection import CHI2_2DOF

_CHI2_1DOF = 3.841
"""95 % quantile of χ²: of a distance to an epipolar line."""
_ENOUGH_DEPTH = 0.5
"""Share of an image's features from which on those with depth suffice: most others then lie at edges, where
what is seen changes with the view."""
_MOST_KEYFRAMES = 10
_MAX_RATIO = 0.8
_MAX_DEPTH_ERROR = 0.5
"""Standard deviation of a triangulated depth, as a share of it: with less parallax it is useless. A limit
that many points are near to keeps those that noise has brought closer, and the scale shrinks."""
_ENOUGH_MEASURED = 20
"""Matched features with measured depth that give a pose its scale."""
_SHARED = 0.5
"""Part of the variance of triangulated landmarks that they share, as an error of scale."""


def add_triangulated(landmark_map: LandmarkMap, index: int, *, except_for: Ids) -> None:
    """Add the landmarks that features without depth of the newest keyframe and its neighbours show.

    Args:
        landmark_map: The map.
        index: The newest keyframe.
        except_for: (K,) features of it to leave out.
    """
    observation = landmark_map.observation(index)
    if observation.has_depth.sum() >= _ENOUGH_DEPTH * len(observation):
        return
    T_camera_world = landmark_map.keyframes[index].T_camera_world
    for k, _ in landmark_map.covisible(index, min_shared=MIN_SHARED_LANDMARKS)[:_MOST_KEYFRAMES]:
        other = landmark_map.observation(k)
        free, free_other = landmark_map.never_linked(index), landmark_map.never_linked(k)
        pairs, points_camera, sigma_m = triangulated(
            observation,
            other,
            np.setdiff1d(free[~observation.has_depth[free]], except_for),
            free_other[~other.has_depth[free_other]],
            landmark_map.keyframes[k].T_camera_world @ inverse(T_camera_world),
        )
        points_world = apply(inverse(T_camera_world), points_camera)
        landmark_map.add_landmarks(points_world, [(k, pairs[:, 1]), (index, pairs[:, 0])], sigma_m)


def weights_with_landmarks(
    landmark_map: LandmarkMap,
    T_camera_world: Transform,
    observation: ImageObservation,
    features: NDArray[np.integer],
    landmarks: Ids,
    weights: Array,
) -> Array:
    """Return a frame's (N, 3) weights where the uncertainty of triangulated landmarks is added to its own.

    Triangulated landmarks can share an error of scale. Where enough features measure the scale, the variances
    along the rays are multiplied as if that part of them were common to all: as many as they are, they do not
    outweigh those.

    Args:
        landmark_map: The map.
        T_camera_world: (4, 4) approximate pose of the frame.
        observation: The frame.
        features: (M,) features matched.
        landmarks: (M,) their landmarks, −1 for none.
        weights: (N, 3) inverse variances of its features, px⁻².
    """
    sigma_m = landmark_map.landmarks["ray_sigma_m"][landmarks]
    uncertain = np.flatnonzero((landmarks >= 0) & (sigma_m > 0.0))
    if not len(uncertain):
        return weights
    is_measured = (landmarks >= 0) & (sigma_m == 0.0) & observation.has_depth[features]
    is_scaled = is_measured.sum() >= _ENOUGH_MEASURED
    ids, features = landmarks[uncertain], features[uncertain]
    position, direction = landmark_map.landmarks["position"][ids], landmark_map.landmarks["direction"][ids]
    slope = ray_slope(T_camera_world, position, direction, observation.intrinsics)
    weights = weights.copy()
    common = 1.0 + _SHARED * (len(uncertain) - 1) if is_scaled else 1.0
    variances = common * (slope * sigma_m[uncertain, np.newaxis]) ** 2
    weights[features] = 1.0 / (1.0 / weights[features] + variances)
    return weights


def triangulated(
    a: ImageObservation,
    b: ImageObservation,
    features_a: NDArray[np.intp],
    features_b: NDArray[np.intp],
    T_b_a: Transform,
) -> tuple[NDArray[np.int32], Points, Array]:
    """Return (M, 2) features of two images that show the same points, and these (M, 3), camera a, metres.

    The third array is the (M,) standard deviation of each point along its ray from camera a, metres.

    A feature's best match is searched along its epipolar line (Hartley & Zisserman 2004, §9.1; Mur-Artal,
    Montiel & Tardós 2015, §VI-C). Points that reproject badly, lie behind a camera or have little parallax
    are left out.

    Args:
        a: One image.
        b: The other one.
        features_a: (N,) features to match.
        features_b: (K,) features to match.
        T_b_a: (4, 4) from camera a to camera b.
    """
    rays_a, rays_b = _rays(a, features_a), _rays(b, features_b)
    matched, depth_m, sigma_m = _triangulated(rays_a, rays_b, np.ascontiguousarray(T_b_a))
    hits = np.flatnonzero(matched >= 0)
    rays = np.column_stack([rays_a.rays[hits], np.ones(len(hits))])
    pairs = np.column_stack([features_a[hits], features_b[matched[hits]]]).astype(np.int32)
    return pairs, rays * depth_m[hits, np.newaxis], sigma_m[hits]


class _Rays(NamedTuple):
    """Features of an image as rays of its camera.

    Attributes:
        rays: (N, 2) x/z and y/z.
        variances: (N,) of these.
        octave: (N,) int32.
        bits: (N, 4) uint64 descriptors.
    """

    rays: Array
    variances: Array
    octave: NDArray[np.int32]
    bits: Bits


def _rays(observation: ImageObservation, features: NDArray[np.intp]) -> _Rays:
    focal_px, centre_px = observation.intrinsics[:2], observation.intrinsics[2:4]
    return _Rays(
        (observation.measured[features, :2] - centre_px) / focal_px,
        1.0 / (observation.weights[features, 0] * focal_px[0] ** 2),
        observation.octave[features],
        observation.bits[features],
    )


@njit(cache=True, nogil=True)
def _triangulated(a, b, T_b_a):  # type: ignore[no-untyped-def]
    """Return for each ray of a the matching one of b, −1 for none, its depth in a, and this depth's sigma."""
    rays_a, variances_a, octave_a, bits_a = a
    rays_b, variances_b, octave_b, bits_b = b
    matched = np.full(len(rays_a), -1, np.int32)
    depth_m, sigma_m = np.zeros(len(rays_a)), np.zeros(len(rays_a))
    owner = np.full(len(rays_b), -1, np.int32)
    distance_of = np.full(len(rays_b), 257, np.int64)
    R, t = T_b_a[:3, :3], T_b_a[:3, 3]
    for i in range(len(rays_a)):
        p = turned(R, np.array([rays_a[i, 0], rays_a[i, 1], 1.0]))
        # The epipolar line of the ray in b: t × R x.
        l0, l1, l2 = t[1] * p[2] - t[2] * p[1], t[2] * p[0] - t[0] * p[2], t[0] * p[1] - t[1] * p[0]
        length2 = l0 * l0 + l1 * l1
        if length2 == 0.0:
            continue
        best, second, best_j, second_octave = 257, 257, -1, -1
        for j in range(len(rays_b)):
            if abs(octave_b[j] - octave_a[i]) > 1:
                continue
            distance = l0 * rays_b[j, 0] + l1 * rays_b[j, 1] + l2
            if distance * distance > _CHI2_1DOF * length2 * (variances_a[i] + variances_b[j]):
                continue
            d = hamming(bits_a, i, bits_b, j)
            if d < best:
                second, second_octave = best, -1 if best_j < 0 else octave_b[best_j]
                best, best_j = d, j
            elif d < second:
                second, second_octave = d, octave_b[j]
        if best > MAX_HAMMING or (second_octave == octave_b[best_j] and best > _MAX_RATIO * second):
            continue
        if best >= distance_of[best_j]:
            continue
        variance = variances_a[i] + variances_b[best_j]
        z, sigma = _depth(p, t, rays_b[best_j], variance)
        if z > 0.0:
            assign(i, best_j, best, matched, owner, distance_of)
            depth_m[i], sigma_m[i] = z, sigma
    return matched, depth_m, sigma_m


@njit(cache=True, nogil=True)
def _depth(p, t, ray, variance):  # type: ignore[no-untyped-def]
    """Return the depth z at which z p + t lies on a ray, (2,) x/z and y/z, and its standard deviation.

    Both are 0 if the point reprojects badly, lies behind a camera or has little parallax.
    """
    x, y = ray[0], ray[1]
    # b sees z p + t along its ray: (x p2 − p0) z = t0 − x t2, and so for y.
    g0, g1 = x * p[2] - p[0], y * p[2] - p[1]
    slope2 = g0 * g0 + g1 * g1
    if slope2 == 0.0:
        return 0.0, 0.0
    z = (g0 * (t[0] - x * t[2]) + g1 * (t[1] - y * t[2])) / slope2
    z_b = z * p[2] + t[2]
    if z < MIN_DEPTH_M or z_b < MIN_DEPTH_M or variance * z_b * z_b > _MAX_DEPTH_ERROR**2 * slope2 * z * z:
        return 0.0, 0.0
    e0, e1 = x - (z * p[0] + t[0]) / z_b, y - (z * p[1] + t[1]) / z_b
    if e0 * e0 + e1 * e1 > CHI2_2DOF * variance:
        return 0.0, 0.0
    return z, np.sqrt(variance / slope2) * z_b


def inlier_landmarks(landmark_map: LandmarkMap, tracked_pose: TrackedPose) -> tuple[Points, Array]:
    """Return the (M, 3) landmarks of a pose's inliers, in the order of their features, and weights."""
    observation, ids = tracked_pose.observation, tracked_pose.landmark_of_feature
    features = np.flatnonzero(ids >= 0)
    weights = weights_with_landmarks(
        landmark_map,
        tracked_pose.T_camera_world,
        observation,
        features,
        ids[features],
        observation.weights,
    )
    return landmark_map.landmarks["position"][ids[features]], weights[features]
