"""Compiled loops over the local map: observers of landmarks, and landmarks visible from a pose."""

import numpy as np
from numba import njit

from mapper.core.linear import turned
from mapper.odometry.local_map.landmarks.paging_kernels import PAGE_BITS, row_of

MIN_DEPTH_M = 0.1
MIN_VIEW_COSINE = 0.5
"""A landmark is searched for if its viewing direction is within 60° of the mean of its observations'."""


@njit(cache=True, nogil=True)
def count_observers(newest, keyframes, older, keyframe_of, slot_of, used, now):
    """Return the page that is missing, −1 if none, and (keyframes,) int64 how many landmarks each observes.

    Args:
        newest: (M,) int32: each landmark's newest observation, −1 for none.
        keyframes: Number of keyframes.
        older: Column of each observation's predecessor of the same landmark, −1 for none.
        keyframe_of: Column, −1 where an observation was removed.
        slot_of: As for ``row_of``.
        used: As for ``row_of``.
        now: As for ``row_of``.
    """
    counts = np.zeros(keyframes, np.int64)
    for e in newest:
        while e >= 0:
            row = row_of(e, slot_of, used, now)
            if row < 0:
                return e >> PAGE_BITS, counts
            if keyframe_of[row] >= 0:
                counts[keyframe_of[row]] += 1
            e = older[row]
    return -1, counts


@njit(cache=True, nogil=True)
def observations_of(newest, older, keyframe_of, slot_of, used, now):
    """Return the page that is missing, −1 if none, and the observations grouped by landmark.

    They are (M + 1,) int32 group starts and (E,) int32 ids; arguments as for ``count_observers``.
    """
    first = np.zeros(len(newest) + 1, np.int32)
    observations = np.empty(4 * len(newest), np.int32)
    k = 0
    for m in range(len(newest)):
        e = newest[m]
        while e >= 0:
            row = row_of(e, slot_of, used, now)
            if row < 0:
                return e >> PAGE_BITS, (first, observations)
            if keyframe_of[row] >= 0:
                if k == len(observations):
                    observations = np.concatenate((observations, np.empty_like(observations)))
                observations[k] = e
                k += 1
            e = older[row]
        first[m + 1] = k
    return -1, (first, observations[:k])


@njit(cache=True, nogil=True)
def project_visible(positions, directions, reach_m, T_camera_world, intrinsics, size_px, log_scale, octaves):
    """Return which landmarks should be visible (V,), their pixels (V, 2) and expected octaves (V,).

    Args:
        positions: (M, 3) metres, world.
        directions: (M, 3) sums of unit viewing directions, world.
        reach_m: (M,) distance at which the landmark would be found in octave 0.
        T_camera_world: (4, 4).
        intrinsics: (5,) fx, fy, cx, cy, bf.
        size_px: Image width and height.
        log_scale: Natural logarithm of the pyramid's scale factor.
        octaves: Number of the detector's octaves.
    """
    rows = np.empty(len(positions), np.int32)
    pixels = np.empty((len(positions), 2))
    octave = np.empty(len(positions), np.int32)
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    centre = -turned(R.T, t)
    n = 0
    for m in range(len(positions)):
        point = positions[m]
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
        s = directions[m]
        length = np.sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2])
        if d0 * s[0] + d1 * s[1] + d2 * s[2] < MIN_VIEW_COSINE * distance * length:
            continue
        level = np.ceil(np.log(reach_m[m] / distance) / log_scale - 0.5)
        rows[n] = m
        pixels[n, 0], pixels[n, 1] = u, v
        octave[n] = min(max(int(level), 0), octaves - 1)
        n += 1
    return rows[:n], pixels[:n], octave[:n]
