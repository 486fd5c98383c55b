"""Kernels of the gyroscope: integration of angular velocities, and vectors of rotations."""

import numpy as np
from numba import njit

from mapper.core.linear import rotation_of


@njit(cache=True, nogil=True)
def integrate(stamps_ns, rates, begins_ns, ends_ns, bias, scale, gap_ns):
    """Return the rotation over each interval, and whether readings cover it."""
    R_begin_end = np.empty((len(begins_ns), 3, 3))
    known = np.zeros(len(begins_ns), np.bool_)
    before, after, step = np.empty(3), np.empty(3), np.empty(3)
    for m in range(len(begins_ns)):
        R = np.eye(3)
        begin, end = begins_ns[m], ends_ns[m]
        if begin >= stamps_ns[0] and end <= stamps_ns[-1]:
            k = max(np.searchsorted(stamps_ns, begin, side="right") - 1, 0)
            known[m] = True
            while stamps_ns[k] < end and k + 1 < len(stamps_ns):
                first, last = max(begin, stamps_ns[k]), min(end, stamps_ns[k + 1])
                width = stamps_ns[k + 1] - stamps_ns[k]
                if width > gap_ns and last > first:
                    known[m] = False
                    break
                duration_s = (last - first) * 1e-9
                for a in range(3):
                    slope = scale * (rates[k + 1, a] - rates[k, a]) / width
                    before[a] = scale * rates[k, a] + slope * (first - stamps_ns[k]) - bias[a]
                    after[a] = scale * rates[k, a] + slope * (last - stamps_ns[k]) - bias[a]
                cone = duration_s * duration_s / 12.0
                for a in range(3):
                    b, c = (a + 1) % 3, (a + 2) % 3
                    step[a] = 0.5 * duration_s * (before[a] + after[a])
                    step[a] += cone * (before[b] * after[c] - before[c] * after[b])
                R = R @ rotation_of(step)
                k += 1
        R_begin_end[m] = R
    return R_begin_end, known


@njit(cache=True, nogil=True)
def rotation_vectors(R):
    """Return the (M, 3) rotation vectors, at most π long, of (M, 3, 3) rotations, by their quaternions."""
    vectors = np.empty((len(R), 3))
    for m in range(len(R)):
        w = np.array([R[m, 2, 1] - R[m, 1, 2], R[m, 0, 2] - R[m, 2, 0], R[m, 1, 0] - R[m, 0, 1]])
        trace = R[m, 0, 0] + R[m, 1, 1] + R[m, 2, 2]
        largest = 0
        for a in range(1, 3):
            if R[m, a, a] > R[m, largest, largest]:
                largest = a
        if trace > R[m, largest, largest]:  # four times the quaternion, by the largest of its numbers
            part = 2.0 * np.sqrt(1.0 + trace)
            scalar = part
            axis = 4.0 * w / part
        else:
            part = 2.0 * np.sqrt(max(1.0 + 2.0 * R[m, largest, largest] - trace, 0.0))
            scalar = 4.0 * w[largest] / part
            axis = np.empty(3)
            for a in range(3):
                axis[a] = 4.0 * (R[m, a, largest] + R[m, largest, a]) / part
            axis[largest] = part
        sine = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
        if scalar < 0.0:
            axis, scalar = -axis, -scalar
        factor = 2.0 * np.arctan2(sine, scalar) / sine if sine > 0.0 else 0.0
        for a in range(3):
            vectors[m, a] = factor * axis[a]
    return vectors
