"""``mapper synth`` from the command line."""

import json

import pytest

from mapper.simulation.config import UNCALIBRATED
from tests.support.command_line import mapper

SMALL = ["--set", "width_px=64", "--set", "height_px=48", "--set", "texture_px_per_m=8"]
TINY = ["--path", "desk", "--seconds", "0.2", *SMALL]
YARD = ["--sensor", "lidar", "--scene", "courtyard", "--seconds", "1", "--set", "sensor.azimuth_steps=90"]


@pytest.fixture
def config_of(tmp_path):
    """Make a log with some options, and return the configuration of its scene."""

    def config(*arguments):
        mapper("synth", tmp_path / "log", *arguments, "--quiet")
        return json.loads((tmp_path / "log/scene.json").read_text())["config"]

    return config


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_noise_scales_every_imperfection(config_of, noise):
    sensor = config_of("--noise", noise, *TINY)["sensor"]
    assert sensor["axial_noise_ratio"] == noise
    assert sensor["dropout_ratio"] == noise
    assert sensor["lateral_noise_px"] == pytest.approx(0.4 * noise)
    assert sensor["disparity_step_px"] == pytest.approx(0.125 * noise)
    assert sensor["image_noise_levels"] == pytest.approx(2.0 * noise)


def test_a_lidar_log_begins_with_its_scenes_own_settings(config_of, tmp_path):
    config = config_of(*YARD, "--rings", "8", "--seed", "3", "--noise", "0.5")
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
    ("scene", "name", "setting"),
    [
        ("corridor", "hall_width_m", 4.5),
        ("white-room", "texture_contrast", 0.0),
        ("flat", "room_size_m", 4.4),
    ],
)
def test_a_cameras_scene_begins_with_its_own_settings(config_of, tmp_path, scene, name, setting):
    knobs = ("--set", "sensor.readout_s=0.01", "--set", "frame_rate_hz=10", "--seconds", "0.1", "--seed", 3)
    config = config_of("--scene", scene, *knobs, *SMALL)
    assert (config[name], config["seed"], config["sensor"]["readout_s"]) == (setting, 3, 0.01)
    assert "depth_scale" not in config["sensor"]
    assert len(list((tmp_path / "log/rgb").iterdir())) == 2


@pytest.mark.parametrize("scene", ["tunnel", "staircase"])
def test_a_lidar_goes_into_tunnels_and_up_stairs(config_of, scene):
    small = ("--seconds", "1", "--set", "sensor.azimuth_steps=60", "--rings", "4")
    assert config_of("--sensor", "lidar", "--scene", scene, *small)["scene"] == scene


def test_an_uncalibrated_sensor_has_every_error_but_those_set_by_hand(config_of):
    sensor = config_of("--uncalibrated", "--set", "sensor.depth_scale=1.03", *TINY)["sensor"]
    assert {name: sensor[name] for name in UNCALIBRATED} == {**UNCALIBRATED, "depth_scale": 1.03}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--scene", "street"), "--scene street: has no meaning with --sensor rgbd"),
        (("--rings", "8"), "--rings 8: has no meaning with --sensor rgbd"),
        (("--sensor", "lidar", "--rooms", "4"), "--rooms 4: has no meaning with --sensor lidar"),
        (("--sensor", "lidar", "--uncalibrated"), "--uncalibrated: has no meaning with --sensor lidar"),
        (("--scene", "hall", "--rooms", "6"), "--rooms 6: has no meaning with --scene hall"),
        (("--plane-at", "2", "--scene", "hall"), "--scene hall: has no meaning with --plane-at"),
        (("--plane-at", "1", "--path", "desk"), "--path desk: has no meaning with --plane-at"),
        (("--plane-at", "1", "--sensor", "lidar"), "--plane-at 1.0: has no meaning with --sensor lidar"),
        (("--sensor", "lidar", "--scene", "staircase", "--wheels"), "do not climb a staircase"),
        (("--scene", "tunnel"), "want one of flat, corridor, hall, white-room, twin-rooms"),
    ],
)
def test_options_that_a_sensor_or_scene_cannot_follow_are_refused(tmp_path, arguments, message):
    assert message in mapper("synth", tmp_path / "log", *arguments, status=1).stderr
    assert not (tmp_path / "log").exists()


@pytest.mark.parametrize(
    ("scene", "moving"),
    [([*YARD, "--rings", "4"], {"pedestrians": 6}), (TINY, {"people": 4, "moving_boxes": 1})],
)
def test_moving_sets_what_the_scene_has_room_for(config_of, scene, moving):
    config = config_of(*scene, "--moving")
    assert moving.items() <= config.items()
    assert "cars" not in config
