"""Rolling shutter: motion of pixels, the readout time of a bundle, and poses without its error."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import apply, exp, inverse
from mapper.core.timebase import NS_PER_S
from mapper.odometry.base import SensorCheck
from mapper.odometry.camera.pixel_motion import depth_velocity, line_phase, pixel_velocity
from mapper.odometry.camera.readout_time import ReadoutTime
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.keyframes.bundle_adjustment import adjust, common_parameter
from mapper.odometry.keyframes.rolling_shutter import _refine

INTRINSICS = np.array([525.0, 520.0, 319.5, 239.5, 40.0])
SIZE_PX, UPRIGHT_PX = (640, 480), (640, 900)
READOUT_S = 0.02


def projected(T_camera_world, points_world):
    x, y, z = apply(T_camera_world, points_world).T
    pixels = np.column_stack([INTRINSICS[0] * x / z, INTRINSICS[1] * y / z]) + INTRINSICS[2:4]
    return pixels, z


def read_by_lines(T_camera_world, points_world, twist, *, readout_s=READOUT_S, size_px=SIZE_PX):
    """Return the pixels and depths of points, each projected at the time when its own line is read."""
    pixels, depth_m = projected(T_camera_world, points_world)
    for _ in range(10):
        for n, phase in enumerate(line_phase(pixels, size_px) * readout_s):
            T_then = inverse(exp(twist[:3] * phase, twist[3:] * phase)) @ T_camera_world
            pixels[n : n + 1], depth_m[n : n + 1] = projected(T_then, points_world[n : n + 1])
    return pixels, depth_m


def points_ahead(rng, count):
    return rng.uniform([-1.2, -0.9, 1.0], [1.2, 0.9, 4.0], (count, 3))


def test_velocities_are_the_derivatives_of_the_projection():
    rng = np.random.default_rng(0)
    points = points_ahead(rng, 50)
    twist = rng.normal(0.0, 1.0, 6)
    step_s = 1e-6
    before, after = (projected(inverse(exp(twist[:3] * t, twist[3:] * t)), points) for t in (-step_s, step_s))
    pixels, depth_m = projected(np.eye(4), points)
    found = pixel_velocity(pixels, depth_m, INTRINSICS, twist)
    assert np.allclose(found, (after[0] - before[0]) / (2 * step_s), rtol=1e-5, atol=1e-3)
    found = depth_velocity(pixels, depth_m, INTRINSICS, twist)
    assert np.allclose(found, (after[1] - before[1]) / (2 * step_s), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("size_px", [SIZE_PX, UPRIGHT_PX])
def test_pose_and_motion_are_found_in_one_image(size_px):
    rng = np.random.default_rng(1)
    points = points_ahead(rng, 300)
    truth = exp(rng.normal(0.0, 0.05, 3), rng.normal(0.0, 0.1, 3))
    twist = np.array([0.3, -0.5, 0.4, 0.5, -0.4, 0.2])
    pixels, _ = read_by_lines(truth, points, twist, size_px=size_px)
    _, depth_m = projected(truth, points)
    measured = np.column_stack([pixels + rng.normal(0.0, 0.3, pixels.shape), INTRINSICS[4] / depth_m])
    loose = np.full(6, 1e-6)
    weights, phases = np.full((300, 3), 10.0), line_phase(measured, size_px)
    found, sweep = _refine(truth, np.zeros(6), loose, points, measured, weights, INTRINSICS, phases)
    assert np.linalg.norm((inverse(truth) @ found)[:3, 3]) < 0.002
    assert np.allclose(sweep[:3], READOUT_S * twist[:3], atol=0.002)
    assert np.allclose(sweep[3:], READOUT_S * twist[3:], atol=0.004)


@pytest.mark.parametrize("readout_s", [READOUT_S, 0.0])
def test_bundle_shows_the_readout_time(readout_s):
    rng = np.random.default_rng(2)
    points = points_ahead(rng, 200)
    poses = np.array([exp(rng.normal(0, 0.03, 3), [0.1 * c, 0.0, 0.0]) for c in range(5)])
    twists = rng.normal(0.0, 0.5, (5, 6))
    edges, measured, slopes = [], [], []
    read = [
        read_by_lines(T, points, twist, readout_s=readout_s) for T, twist in zip(poses, twists, strict=True)
    ]
    for p in range(len(points)):
        for c in range(5):
            pixel, depth_m = read[c][0][p : p + 1], projected(poses[c], points[p : p + 1])[1]
            shift = line_phase(pixel, SIZE_PX) * pixel_velocity(pixel, depth_m, INTRINSICS, twists[c])[0]
            edges.append((c, p))
            measured.append([*(pixel[0] + rng.normal(0.0, 0.3, 2)), INTRINSICS[4] / depth_m[0]])
            slopes.append(-shift)
    free = np.array([-1, 0, 1, 2, 3], np.int32)
    first = np.arange(0, len(edges) + 1, 5).astype(np.int32)
    weights = np.full((len(edges), 3), 0.3**-2)
    no_links = np.empty((0, 2), np.int32), np.empty((0, 4, 4)), np.empty((0, 6, 6))
    arrays = np.array(edges, np.int32), np.array(measured), weights, INTRINSICS
    poses, points, _ = adjust(poses, free, points, first, *arrays, no_links, 1, 10)
    active = np.ones(len(edges), np.bool_)
    information, gradient = common_parameter(poses, free, points, first, *arrays, active, np.array(slopes))
    sigma_s = information**-0.5
    assert sigma_s < 0.001
    second_order_s = 0.05 * readout_s
    assert abs(-gradient / information - readout_s) < 4.0 * sigma_s + second_order_s


def test_readout_time_is_zero_until_it_is_certain():
    readout = ReadoutTime(None, windows_sharing=10)
    readout.learn(information=1e5, gradient=-1e5 * 0.004)
    assert readout.seconds == 0.0
    assert readout.describe(SIZE_PX) == ""
    for _ in range(60):
        readout.learn(information=1e7, gradient=1e7 * (readout.seconds - 0.02))
    assert readout.seconds == pytest.approx(0.02, abs=0.0006)
    assert "rows are read within 20 ms from the top" in readout.describe(SIZE_PX)
    assert "columns are read within 20 ms from the left" in readout.describe(UPRIGHT_PX)


def test_given_readout_time_is_kept():
    readout = ReadoutTime(-0.01, windows_sharing=10)
    readout.learn(information=1e9, gradient=1e9)
    assert readout.seconds == -0.01
    assert not readout.is_estimated
    assert readout.describe(SIZE_PX) == ""  # who gave it knows it


def test_what_the_odometry_knows_of_the_shutter_it_tells(frames):
    odometry = build_frame_odometry(LocalMapConfig())
    assert isinstance(odometry, SensorCheck)
    odometry.track(odometry.observe(frames[0]))
    assert odometry.sensor_notes() == []
    for _ in range(60):
        odometry._map.readout.learn(information=1e7, gradient=1e7 * (odometry._map.readout.seconds + 0.01))
    assert [note[:64] for note in odometry.sensor_notes()] == [
        "rolling shutter: rows are read within 10 ms from the bottom, as "
    ]


@pytest.mark.parametrize("gap_s", [0, 2])
def test_the_motion_before_a_gap_is_not_that_of_the_image_after_it(frames, gap_s):
    after = [replace(frame, stamp_ns=frame.stamp_ns + gap_s * NS_PER_S) for frame in frames[6:9]]
    odometry = build_frame_odometry(LocalMapConfig(readout_s=READOUT_S))
    results = [odometry.track(odometry.observe(frame)) for frame in (*frames[:6], *after)]
    assert all(result.node is not None for result in results)
    speeds = [float(np.linalg.norm(result.twist.translation_mps)) for result in results]
    assert speeds[5] > 0.0
    assert (speeds[6] == 0.0) is (gap_s > 1)
    assert speeds[7] > 0.0
