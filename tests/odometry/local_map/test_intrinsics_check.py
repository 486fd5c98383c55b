"""The check of a camera's intrinsics against images and depth."""

import re

import numpy as np
import pytest

from mapper.core.geometry import apply, exp
from mapper.odometry.local_map.bundle.bundle import WINDOW_KEYFRAMES, Bundle
from mapper.odometry.local_map.calibration.intrinsics_check import IntrinsicsCheck

INTRINSICS = np.array([525.0, 520.0, 319.5, 239.5, 40.0])
WINDOWS = 5


def true_intrinsics(errors):
    """Return the intrinsics of a camera whose given ones have these errors."""
    fx, fy, cx, cy, bf = INTRINSICS
    factor_x, factor_y, shift_x, shift_y = np.exp(errors[0]), np.exp(errors[1]), errors[2], errors[3]
    return np.array([fx * factor_x, fy * factor_y, cx + fx * shift_x, cy + fy * shift_y, bf])


def window(rng, *, errors, k1=0.0):
    """Keyframes before a wall with relief, by a camera with errors of the given intrinsics and of k1."""
    points = np.column_stack([rng.uniform(-2, 2, 300), rng.uniform(-1.5, 1.5, 300), rng.uniform(1.5, 4, 300)])
    poses = [exp(rng.normal(0.0, 0.1, 3), rng.normal(0.0, 0.15, 3)) for _ in range(WINDOW_KEYFRAMES)]
    edges, measured = [], []
    fx, fy, cx, cy, bf = true_intrinsics(errors)
    for p, point in enumerate(points):
        for k, T in enumerate(poses):
            x, y, z = apply(T, point[np.newaxis])[0]
            factor = 1.0 + k1 * (x**2 + y**2) / z**2
            u, v = fx * x / z * factor + cx, fy * y / z * factor + cy
            if 0.0 <= u < 640.0 and 0.0 <= v < 480.0:
                edges.append((k, p))
                measured.append(np.array([u, v, bf / z]) + rng.normal(0.0, [0.5, 0.5, 0.2]))
    weights = np.tile([0.5**-2, 0.5**-2, 0.2**-2], (len(edges), 1))
    features = np.array(edges)[:, 1]
    arrays = np.array(edges, np.int32), features, np.array(measured), weights
    return Bundle(np.array(poses), points, *arrays, INTRINSICS)


def checked(errors, *, windows=WINDOWS, k1=0.0):
    """Return a check of a camera whose given intrinsics are off by these errors."""
    rng = np.random.default_rng(3)
    check = IntrinsicsCheck()
    for _ in range(windows):
        check.add(window(rng, errors=errors, k1=k1))
    return check


@pytest.mark.parametrize(
    ("errors", "wrong"),
    [
        ((0.0, 0.0, 0.0, 0.0), []),
        ((-0.08, -0.08, 0.0, 0.0), ["fx", "fy"]),
        ((0.1, 0.1, 0.0, 0.0), ["fx", "fy"]),
        ((0.0, 0.08, 0.0, 0.0), ["fy"]),
        ((0.0, 0.0, 0.05, 0.0), ["cx"]),
        ((0.0, 0.0, 0.0, -0.05), ["cy"]),
        ((0.06, 0.06, 0.05, -0.05), ["fx", "fy", "cx", "cy"]),
        ((0.008, -0.008, 0.02, -0.02), []),
        ((-0.025, -0.025, 0.0, 0.0), []),
        ((-0.035, -0.035, 0.0, 0.0), ["fx", "fy"]),
    ],
)
def test_intrinsics_are_estimated_together(errors, wrong):
    check = checked(errors)
    found, sigmas = check.estimate()
    assert (sigmas < 0.006).all()
    assert found[4] == 0.0  # no distortion is found
    assert (np.abs(found[:4] - errors) < 4.0 * sigmas[:4] + 0.05 * np.abs(errors).max()).all()
    sentence = "".join(check.contradictions(INTRINSICS))
    named = re.findall(r"(f[xy]|c[xy]) = ", sentence)
    assert named == wrong
    settings = dict(re.findall(r"--set source\.camera\.(\w+)_px=([\d.]+)", sentence))
    assert ("source.camera.distortion" in sentence) == bool(wrong)
    if wrong:
        assert list(settings) == ["fx", "fy", "cx", "cy"]  # which the setting wants together
        np.testing.assert_allclose(
            [float(value) for value in settings.values()], true_intrinsics(errors)[:4], rtol=0.02, atol=4.0
        )


def test_intrinsics_of_images_of_half_the_size_are_found():
    errors = np.array([-np.log(2.0), -np.log(2.0), -0.3, -0.23])
    found, _ = checked(errors).estimate()
    np.testing.assert_allclose(found[:4], errors, atol=0.07)


@pytest.mark.parametrize("k1", [-0.1, -0.04, 0.04, 0.2])
@pytest.mark.parametrize("focal", [0.0, -0.04])
def test_distortion_of_the_lens_is_told_from_a_focal_length(k1, focal):
    check = checked((focal, focal, 0.0, 0.0), k1=k1)
    found, sigmas = check.estimate()
    assert sigmas[4] < 0.005
    expected = (focal, focal, 0.0, 0.0, k1)
    assert (np.abs(found - expected) < 4.0 * sigmas + 0.1 * np.abs(expected).max()).all()
    sentence = "".join(check.contradictions(INTRINSICS))
    assert re.findall(r"(f[xy]|c[xy]) = ", sentence) == (["fx", "fy"] if focal else [])
    assert (
        f"a lens whose radial distortion k1 is {found[4]:+.3f} ± {sigmas[4]:.3f} from the given one"
        in sentence
    )
    assert f"source.camera.distortion, to whose k1, the first number, {found[4]:+.3f} is added" in sentence


def test_noise_is_not_taken_for_distortion():
    """Neither by itself, nor for a part of one that is there."""
    found, sigmas = checked((0.0, 0.0, 0.0, 0.0), k1=0.03, windows=12).estimate()
    assert (np.abs(found - (0.0, 0.0, 0.0, 0.0, 0.03)) < 3.0 * sigmas).all()


def test_few_windows_contradict_nothing():
    check = checked((0.2, 0.2, 0.0, 0.0), windows=2)
    assert check.estimate() is None
    assert check.contradictions(INTRINSICS) == []


def test_windows_without_common_landmarks_are_left_out():
    check = IntrinsicsCheck()
    bundle = window(np.random.default_rng(5), errors=np.zeros(4))
    lonely = bundle.edges[:, 0] == 0
    check.add(
        Bundle(
            bundle.poses, bundle.points, bundle.edges[lonely], bundle.features[lonely],
            bundle.measured[lonely], bundle.weights[lonely], INTRINSICS,
        )
    )  # fmt: skip
    assert check.estimate() is None
