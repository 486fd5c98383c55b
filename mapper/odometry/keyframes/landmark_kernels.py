"""Compiled loops over the local map: observers of landmarks, and landmarks visible from a pose."""

import numpy as np
from numba import njit

from mapper.core.linear import turned

MIN_DEPTH_M = 0.1
MIN_VIEW_COSINE = 0.5
"""A landmark is searched for if its viewing direction is within 60° of the mean of its observations'."""


@njit(cache=True, nogil=True)
def count_observers(landmarks, newest, older, keyframe_of, keyframes):
    """Return (keyframes,) int64, how many of the landmarks each keyframe observes.

    Args:
        landmarks: (M,) int32 ids.
        newest: (L,) int32: each landmark's newest observation, −1 for none.
        older: (E,) int32: each observation's predecessor of the same landmark, −1 for none.
        keyframe_of: (E,) int32, −1 where an observation was removed.
        keyframes: Number of keyframes.
    """
    counts = np.zeros(keyframes, np.int64)
    for landmark in landmarks:
        e = newest[landmark]
        while e >= 0:
            if keyframe_of[e] >= 0:
                counts[keyframe_of[e]] += 1
            e = older[e]
    return counts


@njit(cache=True, nogil=True)
def observations_of(landmarks, newest, older, keyframe_of):
    """Return (M + 1,) int32 group starts and (E,) int32 observations, grouped by landmark."""
    total = 0
    for landmark in landmarks:
        e = newest[landmark]
        while e >= 0:
            total += keyframe_of[e] >= 0
            e = older[e]
    first = np.zeros(len(landmarks) + 1, np.int32)
    observations = np.empty(total, np.int32)
    k = 0
    for m in range(len(landmarks)):
        e = newest[landmarks[m]]
        while e >= 0:
            if keyframe_of[e] >= 0:
                observations[k] = e
                k += 1
            e = older[e]
        first[m + 1] = k
    return first, observations


@njit(cache=True, nogil=True)
def project_visible(
    landmarks, positions, directions, reach_m, T_camera_world, intrinsics, size_px, log_scale, octaves
):
    """Return the rows of ``landmarks`` that should be visible, their pixels (V, 2) and expected octaves (V,).

    Args:
        landmarks: (M,) int32 ids.
        positions: (L, 3) metres, world.
        directions: (L, 3) sums of unit viewing directions, world.
        reach_m: (L,) distance at which the landmark would be found in octave 0.
        T_camera_world: (4, 4).
        intrinsics: (5,) fx, fy, cx, cy, bf.
        size_px: Image width and height.
        log_scale: Natural logarithm of the pyramid's scale factor.
        octaves: Number of the detector's octaves.
    """
    rows = np.empty(len(landmarks), np.int32)
    pixels = np.empty((len(landmarks), 2))
    octave = np.empty(len(landmarks), np.int32)
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    centre = -turned(R.T, t)
    n = 0
    for m in range(len(landmarks)):
        point = positions[landmarks[m]]
        x = R[0, 0] * point[0] + R[0, 1] * point[1] + R[0, 2] * point[2] + t[0]
        y = R[1, 0] * point[0] + R[1, 1] * point[1] + R[1, 2] * point[2] + t[1]
        z = R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2] + t[2]
        if z < MIN_DEPTH_M:
            continue
        u = intrinsics[0] * x / z + intrinsics[2]
        v = intrinsics[1] * y / z + intrinsics[3]
        if not (0.0 <= u < size_px[0] and 0.0 <= v < size_px[1]):
            continue
        d0, d1, d2 = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
        distance = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        s = directions[landmarks[m]]
        length = np.sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2])
        if d0 * s[0] + d1 * s[1] + d2 * s[2] < MIN_VIEW_COSINE * distance * length:
            continue
        level = np.ceil(np.log(reach_m[landmarks[m]] / distance) / log_scale - 0.5)
        rows[n] = m
        pixels[n, 0], pixels[n, 1] = u, v
        octave[n] = min(max(int(level), 0), octaves - 1)
        n += 1
    return rows[:n], pixels[:n], octave[:n]
