"""Kernels of the gyroscope: integration of angular velocities."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def integrate(stamps_ns, rates, begins_ns, ends_ns, bias, gap_ns):  # type: ignore[no-untyped-def]
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
                    slope = (rates[k + 1, a] - rates[k, a]) / width
                    before[a] = rates[k, a] + slope * (first - stamps_ns[k]) - bias[a]
                    after[a] = rates[k, a] + slope * (last - stamps_ns[k]) - bias[a]
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
def rotation_of(vector):  # type: ignore[no-untyped-def]
    """Return the (3, 3) rotation of a (3,) rotation vector (Rodrigues' formula), for compiled code."""
    x, y, z = vector
    squared = x * x + y * y + z * z
    if squared < 1e-16:
        a, b = 1.0, 0.5
    else:
        angle = np.sqrt(squared)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    return R
