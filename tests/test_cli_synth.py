"""``mapper synth`` from the command line."""

import json

import pytest
from typer.testing import CliRunner

from cli.main import app

TINY = ["--path", "desk", "--seconds", "0.2", "--set", "width_px=64", "--set", "height_px=48", "--quiet"]


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_noise_scales_every_imperfection(tmp_path, noise):
    arguments = ["synth", str(tmp_path / "log"), "--noise", str(noise), *TINY]
    assert CliRunner().invoke(app, arguments, catch_exceptions=False).exit_code == 0
    sensor = json.loads((tmp_path / "log/scene.json").read_text())["config"]["sensor"]
    assert sensor["axial_noise_ratio"] == noise
    assert sensor["dropout_ratio"] == noise
    assert sensor["lateral_noise_px"] == pytest.approx(0.4 * noise)
    assert sensor["disparity_step_px"] == pytest.approx(0.125 * noise)
    assert sensor["image_noise_levels"] == pytest.approx(2.0 * noise)
