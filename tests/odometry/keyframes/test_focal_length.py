"""The check of a focal length against images and depth."""

import numpy as np
import pytest

from mapper.core.geometry import apply, exp
from mapper.odometry.keyframes.focal_length import WINDOW_KEYFRAMES, Bundle, FocalLengthCheck

INTRINSICS = np.array([525.0, 520.0, 319.5, 239.5, 40.0])
WINDOWS = 5


def window(rng, *, true_scale):
    """Keyframes before a wall with relief, by a camera of ``true_scale`` times our focal length."""
    points = np.column_stack([rng.uniform(-2, 2, 300), rng.uniform(-1.5, 1.5, 300), rng.uniform(1.5, 4, 300)])
    poses = [exp(rng.normal(0.0, 0.1, 3), rng.normal(0.0, 0.15, 3)) for _ in range(WINDOW_KEYFRAMES)]
    edges, measured = [], []
    fx, fy, cx, cy, bf = INTRINSICS * [true_scale, true_scale, 1.0, 1.0, 1.0]
    for p, point in enumerate(points):
        for k, T in enumerate(poses):
            x, y, z = apply(T, point[np.newaxis])[0]
            u, v = fx * x / z + cx, fy * y / z + cy
            if 0.0 <= u < 640.0 and 0.0 <= v < 480.0:
                edges.append((k, p))
                measured.append(np.array([u, v, bf / z]) + rng.normal(0.0, [0.5, 0.5, 0.2]))
    weights = np.tile([0.5**-2, 0.5**-2, 0.2**-2], (len(edges), 1))
    arrays = np.array(edges, np.int32), np.array(measured), weights
    return Bundle(np.array(poses), points, *arrays, INTRINSICS)


@pytest.mark.parametrize("true_scale", [0.92, 1.0, 1.1])
def test_the_focal_length_is_estimated(true_scale):
    rng = np.random.default_rng(3)
    check = FocalLengthCheck()
    for _ in range(WINDOWS):
        check.add(window(rng, true_scale=true_scale))
    error, sigma = check.estimate()
    assert sigma < 0.003
    assert abs(error - (true_scale - 1.0)) < 4.0 * sigma + 0.05 * abs(true_scale - 1.0)
    assert bool(check.contradiction(INTRINSICS[0])) == (true_scale != 1.0)


def test_few_windows_contradict_nothing():
    rng = np.random.default_rng(4)
    check = FocalLengthCheck()
    for _ in range(3):
        check.add(window(rng, true_scale=1.2))
    assert check.contradiction(INTRINSICS[0]) == ""


def test_windows_without_common_landmarks_are_left_out():
    check = FocalLengthCheck()
    bundle = window(np.random.default_rng(5), true_scale=1.0)
    lonely = bundle.edges[:, 0] == 0
    check.add(
        Bundle(
            bundle.poses, bundle.points, bundle.edges[lonely], bundle.measured[lonely],
            bundle.weights[lonely], INTRINSICS,
        )
    )  # fmt: skip
    assert check.estimate() == (0.0, np.inf)
