"""The check of a depth camera's disparity against images."""

import math

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.geometry import apply, exp
from mapper.odometry.local_map.bundle import WINDOW_KEYFRAMES, Bundle
from mapper.odometry.local_map.depth_bias import DepthBiasCheck
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources.depth_correction import with_corrected_depth
from tests.support.desk_frames import desk_walk

INTRINSICS = np.array([525.0, 520.0, 319.5, 239.5, 40.0])
SIGMA_PX = np.array([0.5, 0.5, 0.2])


def window(rng, *, bias_per_m, nearest_m=2.0, farthest_m=7.0):
    """Keyframes of a camera that walks ahead, whose inverse depths are too small by a bias."""
    points = rng.uniform([-2, -1.5, nearest_m], [2, 1.5, farthest_m], (300, 3))
    poses = [exp(rng.normal(0, 0.05, 3), np.array([0, 0, -0.2 * k])) for k in range(WINDOW_KEYFRAMES)]
    edges, measured = [], []
    fx, fy, cx, cy, bf = INTRINSICS
    for p, point in enumerate(points):
        for k, T in enumerate(poses):
            x, y, z = apply(T, point[np.newaxis])[0]
            u, v = fx * x / z + cx, fy * y / z + cy
            if z > 0.3 and 0.0 <= u < 640.0 and 0.0 <= v < 480.0:
                edges.append((k, p))
                measured.append(np.array([u, v, bf * (1.0 / z - bias_per_m)]) + rng.normal(0.0, SIGMA_PX))
    weights = np.tile(SIGMA_PX**-2, (len(edges), 1))
    arrays = np.array(edges, np.int32), np.array(edges)[:, 1], np.array(measured), weights
    return Bundle(np.array(poses), points, *arrays, INTRINSICS)


def checked(*, bias_per_m, windows=5, **depths):
    rng = np.random.default_rng(3)
    check = DepthBiasCheck()
    for _ in range(windows):
        check.add(window(rng, bias_per_m=bias_per_m, **depths))
    return check


@pytest.mark.parametrize("bias_per_m", [-0.015, 0.0, 0.015])
def test_the_bias_is_estimated(bias_per_m):
    check = checked(bias_per_m=bias_per_m)
    found_per_m, sigma_per_m = check.estimate()
    assert sigma_per_m < 0.001
    assert abs(found_per_m - bias_per_m) < 4.0 * sigma_per_m
    doubt = check.contradiction()
    if bias_per_m == 0.0:
        assert doubt == ""
    else:
        assert f"add {found_per_m:.4f} to source.inverse_depth_offset_per_m" in doubt
        assert ("too large" in doubt) == (bias_per_m > 0.0)


def test_what_changes_the_depths_of_the_log_little_is_usual():
    check = checked(bias_per_m=0.006, nearest_m=1.0, farthest_m=3.0)
    found_per_m, sigma_per_m = check.estimate()
    assert found_per_m > 4.0 * sigma_per_m
    assert check.contradiction() == ""


def test_few_windows_contradict_nothing():
    check = checked(bias_per_m=0.03, windows=3)
    assert check.estimate() == (0.0, math.inf)
    assert check.contradiction() == ""


def test_a_log_with_a_biased_depth_camera_says_so():
    config = load_config(None, ["odometry.max_keyframe_gap=1", "loops.kind=none"], sensor="rgbd")
    right, wrong = (
        [warning.sentence for warning in track_log(log, config, progress=SILENT).warnings]
        for log in (desk_walk(), with_corrected_depth(desk_walk(), -0.06))
    )
    assert right == []
    (sentence,) = wrong
    assert "to source.inverse_depth_offset_per_m" in sentence
