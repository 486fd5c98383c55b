"""``mapper synth`` from the command line."""

import json

import pytest

from tests.support.command_line import invoke

TINY = ["--path", "desk", "--seconds", "0.2", "--set", "width_px=64", "--set", "height_px=48", "--quiet"]


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_noise_scales_every_imperfection(tmp_path, noise):
    arguments = ["synth", str(tmp_path / "log"), "--noise", str(noise), *TINY]
    assert invoke(*arguments).exit_code == 0
    sensor = json.loads((tmp_path / "log/scene.json").read_text())["config"]["sensor"]
    assert sensor["axial_noise_ratio"] == noise
    assert sensor["dropout_ratio"] == noise
    assert sensor["lateral_noise_px"] == pytest.approx(0.4 * noise)
    assert sensor["disparity_step_px"] == pytest.approx(0.125 * noise)
    assert sensor["image_noise_levels"] == pytest.approx(2.0 * noise)


YARD = ["--sensor", "lidar", "--scene", "courtyard", "--seconds", "1", "--set", "sensor.azimuth_steps=90"]


def test_a_lidar_log_begins_with_its_scenes_own_settings(tmp_path):
    arguments = ["synth", str(tmp_path / "log"), *YARD, "--rings", "8", "--seed", "3", "--noise", "0.5"]
    result = invoke(*arguments)
    assert f"mapper build {tmp_path / 'log'}" in result.stdout
    config = json.loads((tmp_path / "log/scene.json").read_text())["config"]
    assert (config["scene"], config["seed"], config["rate_hz"], config["tilt_rad"]) == (
        "courtyard",
        3,
        2,
        0.52,
    )
    assert config["sensor"]["rings"] == 8
    assert config["sensor"]["range_noise_m"] == pytest.approx(0.01)
    assert config["sensor"]["dropout_ratio"] == pytest.approx(0.01)
    assert len(list((tmp_path / "log/velodyne").iterdir())) == 3


@pytest.mark.parametrize(
    ("sensor", "option"),
    [("rgbd", ("--scene", "street")), ("rgbd", ("--rings", "8")), ("lidar", ("--rooms", "4"))],
)
def test_an_option_of_the_other_sensor_is_refused(tmp_path, sensor, option):
    arguments = ["synth", str(tmp_path / "log"), "--sensor", sensor, *option]
    result = invoke(*arguments)
    assert result.exit_code == 1
    assert f"{option[0]} {option[1]}: has no meaning with --sensor {sensor}" in result.stderr
    assert not (tmp_path / "log").exists()
