"""A depth camera's accuracy: the definitions on arrays by hand, and planes whose noise is known."""

import numpy as np
import pytest

from mapper.core.errors import DataError, SourceError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan, ray_table
from mapper.evaluators.sensors.depth_accuracy import Patch, accuracy_of, quantisation_step_m
from mapper.evaluators.sensors.depth_planes import depth_at, depth_of_planes
from mapper.evaluators.sensors.depth_study import fit_noise, study_depth
from mapper.sensing.depth import depth_sigma_m
from mapper.sensing.planes import fit_planes
from mapper.simulation.config import SensorConfig, SynthConfig
from mapper.simulation.source import CameraSimulator
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from tests.support.logs import log_in_memory, memory_entry
from tests.support.paths import FR1_XYZ

CAMERA = PinholeCamera(320, 240, 262.5, 262.5, 159.5, 119.5)
A, B, C = 0.0012, 0.0008, 0.0015


def log_of(depths, camera=CAMERA):
    image = np.full((camera.height_px, camera.width_px), 128, np.uint8)
    frames = [RgbdFrame(i, image, depth.astype(np.float32), camera) for i, depth in enumerate(depths)]
    return log_in_memory([memory_entry(i, frame) for i, frame in enumerate(frames)], name="made")


def plane_m(distance_m, *, tilt_rad=0.0):
    """Depth of a plane turned about the camera's y axis."""
    x = ray_table(CAMERA)[..., 0].astype(np.float64)
    return distance_m / (1.0 + np.tan(tilt_rad) * x)


def wall(distance_m, *, frames=4, tilt_rad=0.0, fixed_m=0.0, sigma_m=None, seed=0):
    rng = np.random.default_rng([seed, int(1e3 * distance_m)])
    exact = plane_m(distance_m, tilt_rad=tilt_rad)
    sigma_m = A + B * exact + C * exact**2 if sigma_m is None else sigma_m
    fixed = fixed_m * rng.standard_normal(exact.shape)
    return log_of([exact + fixed + sigma_m * rng.standard_normal(exact.shape) for _ in range(frames)])


# Definitions


def test_the_largest_error_is_equation_2_46():
    depth_m = np.array([[1.02, 0.0, 0.97], [1.0, 1.01, 1.0]])
    d = 1.0
    measured = depth_m[depth_m > 0]
    found = accuracy_of(depth_m, d)
    assert found.max_error_m == pytest.approx(max(abs(d - measured.min()), abs(d - measured.max())))
    assert found.max_error_m == pytest.approx(0.03)
    assert found.mean_error_m == pytest.approx(0.0)
    assert found.std_m == pytest.approx(np.sqrt((0.02**2 + 0.03**2 + 0.01**2) / 5))


def test_the_worst_one_percent_is_left_out():
    errors = np.concatenate([[0.5, -0.4], np.linspace(-0.01, 0.01, 198)])
    found = accuracy_of(2.0 + errors, 2.0)
    assert (found.max_error_m, found.max_error_99_m) == pytest.approx((0.5, 0.01))
    assert accuracy_of(2.0 + errors[:99], 2.0).max_error_99_m == pytest.approx(0.5), "1 % of 99 is no pixel"


def test_a_reference_may_differ_from_pixel_to_pixel():
    found = accuracy_of(np.array([1.0, 2.0, 0.0]), np.array([1.1, 2.1, 5.0]))
    assert (found.max_error_m, found.mean_error_m, found.std_m) == pytest.approx((0.1, -0.1, 0.0))


def test_nothing_measured_has_no_accuracy():
    with pytest.raises(DataError, match="no pixel has a depth"):
        accuracy_of(np.zeros((3, 3)), 1.0)


def test_the_step_of_quantisation_is_the_usual_gap():
    depth_m = np.array([1.0, 1.003, 1.006, 1.009, 1.1, 0.0, 1.003])
    assert quantisation_step_m(depth_m) == pytest.approx(0.003)
    assert quantisation_step_m(np.array([1.0, 1.0, 1.1])) is None


# Planes


def test_a_plane_is_found_exactly_and_its_tilt_told():
    rays = ray_table(CAMERA).astype(np.float64).reshape(1, -1, 2)
    depth_m = plane_m(1.5, tilt_rad=0.2).reshape(1, -1)
    spoilt = depth_m.copy()
    spoilt[0, ::50] += 0.4
    spoilt[0, 1::50] = 0.0
    for measured_m in (depth_m, spoilt):
        planes = fit_planes(measured_m, rays)
        assert planes.distance_m[0] == pytest.approx(1.5, abs=1e-6)
        assert planes.tilt_rad[0] == pytest.approx(0.2, abs=1e-6)
        np.testing.assert_allclose(planes.depth_m, depth_m, atol=1e-6)
    assert planes.used.mean() == pytest.approx(0.96)


# A camera before a wall


def test_errors_and_noise_of_a_wall():
    level, picture = depth_at(wall(1.0, frames=20, fixed_m=0.002), 0.99)
    sigma_m = A + B + C
    assert level.typical.raw.std_m == pytest.approx(np.hypot(sigma_m, 0.002), rel=0.03)
    assert level.typical.filtered.std_m == pytest.approx(level.typical.raw.std_m / 3.0, rel=0.05), (
        "nine pixels, white noise"
    )
    assert level.typical.raw.mean_error_m == pytest.approx(0.01, abs=2e-4)
    assert level.temporal_m == pytest.approx(sigma_m, rel=0.02)
    assert level.fixed_m == pytest.approx(0.002, rel=0.05)
    assert level.typical.raw.max_error_m > level.typical.raw.max_error_99_m > 0.01 + 2 * sigma_m
    assert (level.frames, level.typical.measured_ratio) == (20, 1.0)
    assert np.isnan(picture.error_m[0, 0])
    assert abs(picture.error_m[120, 160]) < 0.01


@pytest.mark.parametrize("tilt_deg", [2.0, 15.0])
def test_a_wall_that_is_not_quite_across_the_axis_is_no_error(tilt_deg):
    log = wall(1.0, tilt_rad=np.radians(tilt_deg), sigma_m=0.002)
    level, _ = depth_at(log, 1.0)
    assert np.degrees(level.typical.tilt_rad) == pytest.approx(tilt_deg, abs=0.1)
    assert level.typical.raw.std_m == pytest.approx(0.002, rel=0.03)
    assert abs(level.typical.raw.mean_error_m) < 2e-4
    kept, _ = depth_at(log, 1.0, keep_tilt=True)
    ramp_m = plane_m(1.0, tilt_rad=np.radians(tilt_deg))[80:160, 107:213].std()
    assert kept.typical.raw.std_m == pytest.approx(np.hypot(0.002, ramp_m), rel=0.05)


def test_one_frame_tells_nothing_of_time():
    level, _ = depth_at(wall(1.0, frames=1), 1.0)
    assert level.temporal_m is None
    assert level.fixed_m is None


def test_the_patch_decides_what_is_seen():
    log = wall(1.0)
    for entry in log.entries():
        entry.load().depth_m[:, 200:] = 0.7
    level, _ = depth_at(log, 1.0, patch=Patch(0, 0, 200, 240))
    assert level.typical.raw.max_error_m < 0.03
    with pytest.raises(DataError, match=r"none of 4 frames shows a plane; the first: .* lie \d+% off any"):
        depth_at(log, 1.0, patch=Patch(150, 0, 80, 240))


def test_a_patch_with_little_depth_is_refused():
    log = wall(1.0)
    for entry in log.entries():
        entry.load().depth_m[:, 20:] = 0.0
    with pytest.raises(DataError, match=r"10% of the patch .* has depth, want at least 50%"):
        depth_at(log, 1.0, patch=Patch(0, 0, 200, 240))


def test_a_wall_seen_at_a_slant_is_refused():
    with pytest.raises(DataError, match=r"is 40° from lying across the camera's axis, want at most 30°"):
        depth_at(wall(1.0, tilt_rad=np.radians(40.0)), 1.0)


def test_frames_without_the_plane_are_left_out():
    log = wall(1.0, frames=5)
    log.entry_at(2).load().depth_m[:] = 0.0
    assert depth_at(log, 1.0)[0].frames == 4


@pytest.mark.parametrize(
    ("patch", "message"),
    [(Patch(300, 0, 40, 40), "reaches beyond the image of 320×240"), (Patch(0, 0, 2, 40), "at least 3×3")],
)
def test_a_patch_has_to_fit(patch, message):
    with pytest.raises(DataError, match=message):
        depth_at(wall(1.0), 1.0, patch=patch)


def test_distances_in_the_wrong_order_are_refused():
    with pytest.raises(DataError, match=r"shows a plane at 1 m, not at 1.6 m"):
        depth_at(wall(1.0), 1.6)


def test_scans_are_refused():
    scans = [memory_entry(0, Scan(0, np.zeros((1, 3), np.float32)))]
    with pytest.raises(SourceError, match="a log of scans"):
        depth_at(log_in_memory(scans, sensor="lidar"), 1.0)
    with pytest.raises(SourceError, match="no frame can be read; the last: frame 0: a scan"):
        depth_at(log_in_memory(scans), 1.0)


# The noise over the distance

DISTANCES_M = (0.6, 0.9, 1.3, 1.8, 2.4, 3.0)


def test_a_known_noise_is_recovered_from_walls():
    study = study_depth([wall(d, frames=6) for d in DISTANCES_M[::-1]], DISTANCES_M[::-1])
    noise, z = study.fit.noise, np.array(DISTANCES_M)
    assert [level.typical.distance_m for level in study.levels] == list(DISTANCES_M)
    assert study.fit.form == "parabola"
    for value, true, error in zip(
        (noise.constant_m, noise.linear, noise.quadratic_per_m), (A, B, C), study.fit.uncertainty, strict=True
    ):
        assert abs(value - true) < 2e-4
        assert abs(value - true) < 4.0 * error
    np.testing.assert_allclose(depth_sigma_m(noise, z), A + B * z + C * z**2, rtol=0.01)


def test_a_noise_of_the_disparity_is_told_by_one_number():
    logs = [wall(d, sigma_m=0.0019 * d**2) for d in DISTANCES_M]
    fit = study_depth(logs, DISTANCES_M).fit
    assert fit.form == "disparity"
    assert fit.noise.quadratic_per_m == pytest.approx(0.0019, rel=0.01)
    assert fit.noise.constant_m == fit.noise.linear == 0.0


def test_few_distances_tell_one_number_and_one_tells_no_uncertainty():
    z = np.array([1.0, 2.0, 3.0])
    three = fit_noise(z, A + B * z + C * z**2)
    assert three.form == "disparity"
    assert three.uncertainty[2] > 0.0
    assert np.isnan(fit_noise(z[:1], np.array([0.004])).uncertainty[2])


def test_a_curve_that_falls_to_zero_is_not_believed():
    z = np.linspace(1.0, 3.0, 9)
    found = fit_noise(z, np.maximum(0.004 * (z - 1.02) ** 2, 1e-5))
    assert (depth_sigma_m(found.noise, np.linspace(0.1, 5.0, 50)) > 0.0).all()


def test_a_perfect_sensor_has_no_noise_to_fit():
    with pytest.raises(DataError, match="depths that scatter"):
        fit_noise(np.array([1.0]), np.array([0.0]))


# Planes that a log happens to show


def corner(distance_m, *, seed=0):
    """A wall, a floor before it, and a ball in the middle that is no plane; the noise is A, B, C."""
    x, y = np.moveaxis(ray_table(CAMERA).astype(np.float64), 2, 0)
    exact = np.minimum(distance_m / (1.0 + 0.3 * x), 0.5 * distance_m / np.maximum(y, 1e-3))
    rows, columns = np.mgrid[:240, :320]
    ball = np.maximum(1.0 - ((rows - 100) / 60.0) ** 2 - ((columns - 160) / 60.0) ** 2, 0.0) ** 0.5
    exact -= 0.4 * ball
    rng = np.random.default_rng(seed)
    return exact + (A + B * exact + C * exact**2) * rng.standard_normal(exact.shape)


def test_noise_is_recovered_from_whatever_planes_there_are():
    log = log_of([corner(d, seed=k) for k, d in enumerate(np.linspace(0.9, 3.0, 14))])
    levels, _ = depth_of_planes(log)
    z = np.array([level.typical.distance_m for level in levels])
    assert z[0] < 1.1
    assert z[-1] > 2.3
    np.testing.assert_allclose([level.typical.raw.std_m for level in levels], A + B * z + C * z**2, rtol=0.06)
    np.testing.assert_allclose(
        [level.typical.filtered.std_m / level.typical.raw.std_m for level in levels], 1.0 / 3.0, rtol=0.1
    )
    fit = fit_noise(z, np.array([level.typical.raw.std_m for level in levels]))
    np.testing.assert_allclose(depth_sigma_m(fit.noise, z), A + B * z + C * z**2, rtol=0.05)


def test_no_more_frames_than_asked_for_are_looked_at_and_no_balls():
    log = log_of([corner(0.9, seed=k) for k in range(9)])
    levels, picture = depth_of_planes(log, most_frames=4)
    assert {level.frames for level in levels} == {3}
    assert np.isnan(picture.error_m[60:140, 120:200]).mean() > 0.7, "a ball is no plane"
    assert not np.isnan(picture.error_m[:40]).any()


def test_a_log_without_planes_is_refused():
    rng = np.random.default_rng(0)
    rough = [1.5 + 0.3 * rng.standard_normal((240, 320)).cumsum(axis=1) / 10.0 for _ in range(3)]
    with pytest.raises(DataError, match="no distance has 30 of 3 frames; want walls, floors or tables"):
        depth_of_planes(log_of(np.maximum(rough, 0.2)))


@pytest.mark.skipif(not FR1_XYZ.is_dir(), reason=f"no {FR1_XYZ}")
def test_a_real_kinect_is_as_noisy_as_was_published():
    log = open_source(FR1_XYZ, SourceConfig(first_frame=20, last_frame=400, stride=60))
    levels, picture = depth_of_planes(log)
    z = np.array([level.typical.distance_m for level in levels])
    assert len(z) >= 3
    assert 0.6 < z[0] < z[-1] < 3.5
    std_m = np.array([level.typical.raw.std_m for level in levels])
    # Khoshelham & Elberink (2012) found 1.43 mm/m², Nguyen et al. (2012) 1.2 mm + 1.9 mm/m² · (z − 0.4 m)².
    assert (std_m > 0.9 * 0.00143 * z**2).all()
    assert (std_m < 1.3 * (0.0012 + 0.0019 * (z - 0.4) ** 2)).all()
    ratio = np.array([level.typical.filtered.std_m for level in levels]) / std_m
    assert ((ratio > 0.6) & (ratio < 0.9)).all(), "neighbours share noise, so DIF takes less than two thirds"
    steps_m = np.array([level.typical.step_m for level in levels])
    # An eighth of a pixel at bf = 43.5 px m; the files are rounded to whole millimetres.
    np.testing.assert_allclose(steps_m, 0.125 / 43.5 * z**2, atol=0.001)
    assert 0.05 < (~np.isnan(picture.error_m)).mean() < 0.9


# The synthetic Kinect


BARE = SynthConfig(
    path="wall",
    duration_s=0.04,
    width_px=320,
    height_px=240,
    texture_px_per_m=8,
    furniture_per_room=0,
    posters_per_room=0,
    shake_m=0.0,
    shake_rad=0.0,
    sensor=SensorConfig(disparity_step_px=0.0, lateral_noise_px=0.0),
)


def test_the_synthetic_kinect_is_as_noisy_as_nguyen_et_al_measured():
    for distance_m in (0.8, 2.5):
        log = CameraSimulator(BARE.model_copy(update={"wall_distance_m": distance_m})).log()
        level, _ = depth_at(log, distance_m)
        assert level.typical.raw.std_m == pytest.approx(0.0012 + 0.0019 * (distance_m - 0.4) ** 2, rel=0.05)
        assert level.typical.filtered.std_m > 0.5 * level.typical.raw.std_m, "half of its noise is in patches"
        assert abs(level.typical.raw.mean_error_m) < 0.1 * level.typical.raw.std_m


def test_a_wall_beyond_the_room_is_refused():
    with pytest.raises(SourceError, match=r"wall_distance_m 9: the room is 4\.\d\d m wide"):
        CameraSimulator(BARE.model_copy(update={"wall_distance_m": 9.0})).log()
