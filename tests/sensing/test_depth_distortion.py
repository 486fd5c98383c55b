"""Depth distortion measured on the planes of a log."""

import numpy as np
import pytest

from mapper.core.frames import ray_table
from mapper.sensing import depth_distortion
from mapper.sensing.depth_distortion import measure_distortion
from mapper.simulation.config import SensorConfig, SynthConfig
from mapper.simulation.sensor import BASELINE_M, DISPARITY_FOCAL_PX, warp_of
from mapper.simulation.source import CameraSimulator
from tests.support.bent_depth import CAMERA, images, off_planes, smooth_error


def measured(seen):
    return measure_distortion(seen, ray_table(CAMERA))


@pytest.fixture(scope="module")
def truth():
    return smooth_error()


@pytest.fixture(scope="module")
def found(truth):
    return measured(images(error_per_m=truth))


def test_the_error_is_found_but_for_its_part_on_planes(found, truth):
    wrong = found.error_per_m - truth
    assert np.corrcoef(found.error_per_m.ravel(), truth.ravel())[0, 1] > 0.97
    assert wrong.std() < 0.25 * truth.std()
    assert found.rms_per_m == pytest.approx(truth.std(), rel=0.1)
    plane = 0.01 * ray_table(CAMERA)[..., 0] - 0.02
    same = measured(images(error_per_m=truth + plane))
    np.testing.assert_allclose(same.error_per_m, found.error_per_m, atol=0.2 * truth.std())


@pytest.mark.parametrize("rms_per_m", [0.008, 0.012])
def test_cells_that_it_takes_off_their_planes_do_not_hide_it(rms_per_m):
    truth = smooth_error(rms_per_m)
    found = measured(images(error_per_m=truth)).error_per_m
    assert np.polyfit(truth.ravel(), found.ravel(), 1)[0] == pytest.approx(1.0, abs=0.05)
    assert (found - truth).std() < 0.15 * rms_per_m


def test_corrected_depth_is_nearer_to_the_truth(found, truth):
    exact, bent = (np.array(images(error_per_m=error, sigma_per_m=0.0)) for error in (0.0, truth))
    corrected = np.array([found.corrected(depth_m) for depth_m in bent])
    assert corrected.dtype == np.float32
    assert np.abs(corrected - exact).mean() < 0.3 * np.abs(bent - exact).mean()
    assert found.rms_m == pytest.approx(found.rms_per_m * found.median_depth_m**2)
    assert found.median_depth_m == pytest.approx(np.median(bent), rel=0.1)


def test_what_is_not_measured_stays_so(found):
    depth_m = images(frames=1)[0]
    depth_m[:30] = 0.0
    depth_m[50] = 1e6
    corrected = found.corrected(depth_m)
    assert not corrected[:30].any()
    assert ((corrected[50] > 0.0) == (found.error_per_m[50] < 1e-6)).all(), "beyond infinity is nowhere"
    assert (corrected[60:] > 0.0).all()


def test_an_exact_camera_has_none():
    for sigma_per_m in (0.0, 0.002, 0.005):
        assert measured(images(sigma_per_m=sigma_per_m)) is None


def test_a_camera_that_stands_still_before_relief_has_none(truth):
    assert measured(images(error_per_m=truth, moves=False)) is None


def relief_seen(sway_m, *, frames=40):
    """Return (H, W) depths of uneven ground 1.2 m ahead, from up to (3,) metres right, down and ahead."""
    x, y = np.moveaxis(ray_table(CAMERA).astype(np.float64), 2, 0)
    seen = []
    for k in range(frames):
        right_m, down_m, ahead_m = np.array(sway_m) * np.sin(np.array([0.9, 0.7, 0.4]) * k)
        height_m = 1.2 - ahead_m
        across_m, along_m = right_m + x * height_m, down_m + y * height_m
        relief_m = 0.012 * (np.sin(7.0 * across_m + 1.0) * np.cos(6.0 * along_m) + np.cos(9.0 * across_m))
        seen.append((height_m - relief_m).astype(np.float32))
    return seen


@pytest.mark.parametrize("sway_m", [(0.1, 0.1, 0.2), (0.1, 0.1, 0.3), (0.15, 0.15, 0.3), (0.2, 0.2, 0.3)])
def test_relief_that_stays_in_view_is_none(monkeypatch, sway_m):
    seen = relief_seen(sway_m)
    assert measured(seen) is None
    monkeypatch.setattr(depth_distortion, "_MIN_EXPLAINED", -1.0)
    assert measured(seen) is not None, "without the cross-validation it would be taken for distortion"


def test_an_error_that_changes_is_none(truth):
    first, second = images(error_per_m=truth, frames=20), images(error_per_m=-truth, frames=20)
    assert measured(first + second) is None
    upside_down = images(error_per_m=off_planes(truth[::-1] * [[1.0, -1.0] * 80]), frames=20)
    assert measured(first + upside_down) is None


def test_few_frames_and_few_planes_show_none(truth):
    assert measured(images(error_per_m=truth, frames=14)) is None
    rng = np.random.default_rng(0)
    clutter = [(1.0 / rng.uniform(0.3, 1.5, (120, 160))).astype(np.float32) for _ in range(20)]
    assert measured(clutter) is None
    assert measured([]) is None


@pytest.mark.parametrize(("warp_px", "left"), [(0.1, 0.4), (0.3, 0.15)])
def test_the_warp_of_the_simulator_is_found(warp_px, left):
    sensor = SensorConfig(disparity_warp_px=warp_px)
    config = SynthConfig(seed=4, width_px=160, height_px=120, sensor=sensor)
    simulator = CameraSimulator(config)
    log = simulator.log()
    seen = [log.entry_at(k).load(colour=False).depth_m for k in range(0, len(log), len(log) // 50)]
    rays = ray_table(simulator.camera).astype(np.float64)
    found = measure_distortion(seen, rays)
    flat = np.concatenate([rays, np.ones((120, 160, 1))], axis=2).reshape(-1, 3)
    truth = warp_of(config).ravel() / (BASELINE_M * DISPARITY_FOCAL_PX)
    truth = truth - flat @ np.linalg.lstsq(flat, truth, rcond=None)[0]
    assert (found.error_per_m.ravel() - truth).std() < left * truth.std()
