"""Wheel odometry goes over with a log into other formats, and comes back; inspection tells of it."""

import json

import numpy as np
import pytest

from mapper.simulation import CameraSimulator, write_tum_log
from mapper.simulation.lidar import LidarSimulator
from mapper.sources import open_source
from mapper.sources.config import SourceConfig, WheelsConfig
from mapper.sources.writers import left_out, write_log
from tests.support.command_line import invoke
from tests.support.wheeled_worlds import EXACT, FLAT, STREET_ON_WHEELS

SHORT = FLAT.model_copy(update={"duration_s": 2.0, "wheels": EXACT.model_copy(update={"rate_hz": 20.0})})


@pytest.fixture(scope="module")
def flat():
    return CameraSimulator(SHORT).log()


@pytest.fixture(scope="module")
def street():
    return LidarSimulator(STREET_ON_WHEELS.model_copy(update={"duration_s": 0.5})).log()


def assert_same_wheels(source, again):
    np.testing.assert_array_equal(again.wheels.stamps_ns, source.wheels.stamps_ns)
    np.testing.assert_allclose(again.wheels.T_world_body, source.wheels.T_world_body, atol=1e-8)


@pytest.mark.parametrize("name", ["tum", "log.mcap", "log.bag"])
def test_a_cameras_wheels_come_back(flat, tmp_path, name):
    kind = name.removeprefix("log.")
    write_log(flat, tmp_path / name, kind=kind)
    again = open_source(tmp_path / name)
    assert_same_wheels(flat, again)
    assert left_out(flat, kind) == []
    mounted = SourceConfig(wheels=WheelsConfig(body_in_base=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
    if kind != "tum":  # the poses are the camera's own, and no mounting moves them
        assert_same_wheels(flat, open_source(tmp_path / name, mounted))
        assert any(note.startswith("wheel odometry /wheel_odometry") for note in again.choices)


@pytest.mark.parametrize("name", ["kitti", "log.mcap", "log.bag"])
def test_a_lidars_wheels_come_back(street, tmp_path, name):
    write_log(street, tmp_path / name, kind=name.removeprefix("log."))
    assert_same_wheels(street, open_source(tmp_path / name))


def test_what_a_format_has_no_place_for_is_told(flat, tmp_path):
    assert left_out(flat, "mbag") == ["mbag has no place for wheel odometry; left out"]
    write_log(flat, tmp_path / "log", kind="tum")
    arguments = ["convert", str(tmp_path / "log"), "--as", "mbag", "--out", str(tmp_path / "mbag")]
    told = invoke(*arguments)
    assert told.exit_code == 0
    assert "mbag has no place for wheel odometry; left out" in told.stderr
    assert open_source(tmp_path / "mbag").wheels is None


def test_inspection_tells_rate_span_and_gaps(tmp_path):
    write_tum_log(tmp_path / "log", SHORT)
    path = tmp_path / "log/wheels.txt"
    lines = path.read_text().splitlines()
    begin = len(lines) - 42
    path.write_text("\n".join(lines[: begin + 10] + lines[begin + 20 :]) + "\n")
    told = invoke("inspect", tmp_path / "log").stdout
    assert "32 poses over" in told
    (row,) = [line for line in told.splitlines() if line.startswith("wheels")]
    assert row.endswith("m: 2.0 s at 20.0 Hz, 1 gap, the longest 0.55 s")
    facts = json.loads(invoke("inspect", tmp_path / "log", "--json").stdout)
    assert (facts["log"]["wheels"]["count"], facts["log"]["wheels"]["gaps"]) == (32, 1)
