"""``mapper synth`` from the command line."""

import json

import pytest

from mapper.simulation.config import UNCALIBRATED
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


@pytest.mark.parametrize(
    ("scene", "name", "setting"),
    [
        ("corridor", "hall_width_m", 4.5),
        ("white-room", "texture_contrast", 0.0),
        ("flat", "room_size_m", 4.4),
    ],
)
def test_a_cameras_scene_begins_with_its_own_settings(tmp_path, scene, name, setting):
    small = ["--seconds", "0.1", *TINY[4:], "--set", "texture_px_per_m=8"]
    arguments = ["synth", str(tmp_path / "log"), "--scene", scene, "--set", "sensor.readout_s=0.01", *small]
    assert invoke(*arguments).exit_code == 0
    config = json.loads((tmp_path / "log/scene.json").read_text())["config"]
    assert config[name] == setting
    assert config["sensor"]["readout_s"] == 0.01
    assert "depth_scale" not in config["sensor"]


def test_an_uncalibrated_sensor_has_every_error_but_those_set_by_hand(tmp_path):
    settings = ["--set", "sensor.depth_scale=1.03", "--set", "texture_px_per_m=8"]
    assert invoke("synth", str(tmp_path / "log"), "--uncalibrated", *settings, *TINY).exit_code == 0
    sensor = json.loads((tmp_path / "log/scene.json").read_text())["config"]["sensor"]
    assert sensor["depth_scale"] == 1.03
    assert {name: sensor[name] for name in UNCALIBRATED if name != "depth_scale"} == {
        name: value for name, value in UNCALIBRATED.items() if name != "depth_scale"
    }
    refused = invoke("synth", str(tmp_path / "other"), "--sensor", "lidar", "--uncalibrated")
    assert "--uncalibrated: has no meaning with --sensor lidar" in refused.stderr


@pytest.mark.parametrize("scene", ["tunnel", "staircase"])
def test_a_lidar_goes_into_tunnels_and_up_stairs(tmp_path, scene):
    small = ["--seconds", "1", "--set", "sensor.azimuth_steps=60", "--rings", "4", "--quiet"]
    assert (
        invoke("synth", str(tmp_path / "log"), "--sensor", "lidar", "--scene", scene, *small).exit_code == 0
    )
    assert json.loads((tmp_path / "log/scene.json").read_text())["config"]["scene"] == scene


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--scene", "hall", "--rooms", "6"), "--rooms 6: has no meaning with --scene hall"),
        (("--plane-at", "2", "--scene", "hall"), "--scene hall: has no meaning with --plane-at"),
        (("--sensor", "lidar", "--scene", "staircase", "--wheels"), "do not climb a staircase"),
        (("--scene", "tunnel"), "want one of flat, corridor, hall, white-room, twin-rooms"),
    ],
)
def test_options_that_a_scene_cannot_follow_are_refused(tmp_path, arguments, message):
    result = invoke("synth", str(tmp_path / "log"), *arguments)
    assert result.exit_code == 1
    assert message in result.stderr
    assert not (tmp_path / "log").exists()


def test_moving_sets_what_the_scene_has_room_for(tmp_path):
    yard = ["synth", str(tmp_path / "yard"), *YARD, "--rings", "4", "--moving", "--quiet"]
    flat = ["synth", str(tmp_path / "flat"), *TINY, "--moving"]
    for arguments in (yard, flat):
        assert invoke(*arguments).exit_code == 0

    outdoors, indoors = (
        json.loads((tmp_path / name / "scene.json").read_text())["config"] for name in ("yard", "flat")
    )
    assert outdoors["pedestrians"] == 6
    assert "cars" not in outdoors
    assert (indoors["people"], indoors["moving_boxes"]) == (4, 1)
