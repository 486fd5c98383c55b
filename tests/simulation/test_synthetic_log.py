"""What the synthetic camera reports, and the logs that are made of it."""

import json
import tomllib

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.simulation import CameraSimulator, Rendering, observe, read_scene, write_tum_log
from mapper.simulation.config import SensorConfig, SynthConfig
from mapper.simulation.kinect import BASELINE_M, DISPARITY_FOCAL_PX, axial_sigma_m
from mapper.simulation.path import seconds_of
from mapper.sources import open_source
from mapper.sources.trajectory_files import read_tum
from tests.support.ideal_sensors import IDEAL_SENSOR

PLAIN = SynthConfig(
    furniture_per_room=2,
    posters_per_room=1,
    texture_px_per_m=16,
    width_px=160,
    height_px=120,
    sensor=IDEAL_SENSOR,
)


def changed(config, **knobs):
    return config.model_copy(update=knobs)


@pytest.fixture(scope="module")
def source():
    return CameraSimulator(PLAIN)


def flat(depth_m, *, width=320, height=240):
    shape = (height, width)
    depth = np.full(shape, depth_m, dtype=np.float32)
    gray = np.full((*shape, 3), 128, dtype=np.uint8)
    return Rendering(gray, depth, np.zeros(shape, np.int32), np.ones(shape, np.float32))


@pytest.mark.parametrize("depth_m", [0.8, 1.5, 3.0])
def test_depth_noise_follows_nguyen(depth_m):
    sensor = changed(IDEAL_SENSOR, axial_noise_ratio=1.0)
    seen = [
        observe(flat(depth_m), focal_px=262, sensor=sensor, rng=np.random.default_rng(i)) for i in range(5)
    ]
    errors_m = np.array([depth for _, depth in seen]) - depth_m

    sigma_m = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    assert float(axial_sigma_m(np.array(depth_m))) == pytest.approx(sigma_m)
    assert errors_m.std() == pytest.approx(sigma_m, rel=0.05)
    assert abs(errors_m.mean()) < 0.1 * sigma_m
    neighbours = np.corrcoef(errors_m[:, :, 1:].ravel(), errors_m[:, :, :-1].ravel())[0, 1]
    assert 0.3 < neighbours < 0.55, "half of the variance comes in patches"


@pytest.mark.parametrize("depth_m", [2.0, 5.0])
def test_noise_of_the_disparity_grows_with_the_square_of_the_depth(depth_m):
    sensor = changed(IDEAL_SENSOR, disparity_noise_px=0.2)
    seen = [
        observe(flat(depth_m), focal_px=262, sensor=sensor, rng=np.random.default_rng(i)) for i in range(5)
    ]
    errors_m = np.array([depth for _, depth in seen]) - depth_m
    assert errors_m.std() == pytest.approx(0.2 * depth_m**2 / 43.5, rel=0.05)


def test_depth_comes_in_eighths_of_a_pixel_of_disparity():
    sensor = SensorConfig(dropout_ratio=0.0)
    _, depth_m = observe(flat(2.5), focal_px=262, sensor=sensor, rng=np.random.default_rng(0))
    eighths = 8.0 * BASELINE_M * DISPARITY_FOCAL_PX / depth_m.astype(float)

    np.testing.assert_allclose(eighths, np.rint(eighths), atol=1e-3)
    assert 2 < len(np.unique(depth_m)) < 12


def test_no_depth_too_near_too_far_or_at_a_slant():
    kinect = SensorConfig()

    def share(rendering):
        _, depth_m = observe(rendering, focal_px=262, sensor=kinect, rng=np.random.default_rng(0))
        return (depth_m > 0.0).mean()

    assert share(flat(0.39)) == share(flat(8.1)) == 0.0
    assert share(flat(2.0)) > 0.99
    assert 0.2 < share(flat(6.5)) < 0.8
    steep = flat(2.0)
    steep.cosine[:] = 0.05
    assert share(steep) < 0.1


def test_a_near_thing_throws_a_shadow_to_its_left():
    rendering = flat(3.0)
    rendering.depth_m[:, 150:] = 1.0
    focal_px = 400.0
    shadow_px = focal_px * BASELINE_M * (1.0 / 1.0 - 1.0 / 3.0)

    _, depth_m = observe(rendering, focal_px=focal_px, sensor=SensorConfig(), rng=np.random.default_rng(0))

    valid = (depth_m > 0.0).mean(axis=0)
    assert (valid[round(150 - shadow_px) + 1 : 149] == 0.0).all()
    assert (valid[: round(150 - shadow_px) - 2] > 0.9).all()
    assert (valid[155:] > 0.9).all()


def test_image_noise_has_its_size_and_no_bias():
    sensor = changed(IDEAL_SENSOR, image_noise_levels=3.0)
    image, _ = observe(flat(2.0), focal_px=262, sensor=sensor, rng=np.random.default_rng(0))
    assert image.std() == pytest.approx(3.0, rel=0.05)
    assert image.mean() == pytest.approx(128.0, abs=0.05)


def test_exposure_blurs_what_moves_and_leaves_depth_alone(source):
    spin = changed(PLAIN, path="spin", max_yaw_rate_rad_s=2.0)
    sharp = CameraSimulator(spin, source.scene).render(30)
    exposed = changed(spin, sensor=changed(IDEAL_SENSOR, exposure_s=0.03))
    blurred = CameraSimulator(exposed, source.scene).render(30)

    def contrast(rgb):
        return np.abs(np.diff(rgb.astype(float), axis=1)).mean()

    assert contrast(blurred.rgb) < 0.8 * contrast(sharp.rgb)
    assert blurred.rgb.mean() == pytest.approx(sharp.rgb.mean(), rel=0.05)
    np.testing.assert_array_equal(blurred.depth_m, sharp.depth_m)


def test_a_frame_does_not_depend_on_the_others(source):
    config = changed(PLAIN, sensor=SensorConfig())
    noisy = CameraSimulator(config, source.scene).log()
    entries = list(noisy.entries())
    alone = CameraSimulator(config, source.scene).log().entry_at(20).load()
    for entry in entries[18:20]:
        entry.load()
    after_others = entries[20].load()

    np.testing.assert_array_equal(alone.image, after_others.image)
    np.testing.assert_array_equal(alone.depth_m, after_others.depth_m)
    assert (entries[21].load().image != alone.image).any()
    assert entries[20].load(colour=False).image.ndim == 2


def test_dropped_frames_are_missing_and_a_covered_lens_is_black(source):
    config = changed(PLAIN, drop_ratio=0.2, blackout_start_s=1.0, blackout_duration_s=0.5)
    lossy = CameraSimulator(config, source.scene).log()
    entries = list(lossy.entries())

    assert len(entries) == len(lossy)
    assert 0.74 < len(lossy) / len(source.truth) < 0.86
    for entry in entries[::4][:20]:
        seconds = seconds_of(np.array([entry.stamp_ns]))[0]
        frame = entry.load()
        assert (frame.image.max() == 0) == (frame.depth_m.max() == 0.0) == (1.0 <= seconds < 1.5)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    out = tmp_path_factory.mktemp("synthetic") / "log"
    config = changed(PLAIN, duration_s=0.3, sensor=SensorConfig())
    seen = []
    write_tum_log(out, config, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i, 10) for i in range(1, 11)]
    return out, CameraSimulator(config)


def test_the_folder_reads_back_as_the_source_in_memory(log):
    out, source = log
    opened = open_source(out)

    assert opened.kind == "tum"
    assert list(opened.notes) == []
    assert len(opened) == len(source.log()) == 10
    for written, made in zip(opened.entries(), source.log().entries(), strict=True):
        frame, expected = written.load(), made.load()
        assert frame.stamp_ns == expected.stamp_ns
        assert frame.camera == expected.camera
        np.testing.assert_array_equal(frame.image, expected.image)
        np.testing.assert_allclose(frame.depth_m, expected.depth_m, atol=1.01e-4)


def test_truth_calibration_and_scene_are_exact(log):
    out, source = log
    truth = read_tum(out / "groundtruth.txt")
    calibration = tomllib.loads((out / "calibration.toml").read_text())

    np.testing.assert_array_equal(truth.stamps_ns, source.truth.stamps_ns)
    np.testing.assert_allclose(truth.T_world_body, source.truth.T_world_body, atol=1e-14)
    assert calibration["fx_px"] == source.camera.fx_px
    assert calibration["depth_factor"] == 5000.0
    assert read_scene(out / "scene.json").as_json() == source.scene.boxes.as_json()
    assert SynthConfig(**json.loads((out / "scene.json").read_text())["config"]) == source.config


def test_the_same_configuration_writes_the_same_bytes(log, tmp_path):
    out, source = log
    write_tum_log(tmp_path / "again", source.config)
    files = sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file())
    assert len(files) == 25
    for file in files:
        assert (out / file).read_bytes() == (tmp_path / "again" / file).read_bytes()


def test_colour_can_be_jpeg(tmp_path):
    config = changed(PLAIN, duration_s=0.04, image_format="jpg", path="desk")
    write_tum_log(tmp_path / "log", config)
    assert len(list((tmp_path / "log/rgb").glob("*.jpg"))) == 2
    assert len(list(open_source(tmp_path / "log").entries())) == 2


def test_an_existing_folder_is_refused_and_a_failure_leaves_nothing(log, tmp_path):
    out, source = log
    with pytest.raises(SourceError, match="exists already"):
        write_tum_log(out, source.config)

    def stop(_done, _total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_tum_log(tmp_path / "log", source.config, on_progress=stop)
    assert list(tmp_path.iterdir()) == []
