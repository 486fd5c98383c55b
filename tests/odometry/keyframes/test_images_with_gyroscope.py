"""Images of a camera that turns fast, tracked with the gyroscope of the log."""

from dataclasses import replace

import pytest

from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import odometry_for
from mapper.simulation.config import SynthConfig, SynthImuConfig
from mapper.simulation.source import CameraSimulator

SPINNING = SynthConfig(
    path="spin",
    seed=3,
    frame_rate_hz=6.0,
    duration_s=6.0,
    width_px=320,
    height_px=240,
    imu=SynthImuConfig(),
    texture_px_per_m=128,
)


@pytest.fixture(scope="module")
def log():
    return CameraSimulator(SPINNING).log()


@pytest.mark.parametrize("has_gyroscope", [True, False])
def test_an_image_of_another_direction_is_only_placed_where_no_gyroscope_rules_it_out(log, has_gyroscope):
    known = replace(log, gyroscope=log.gyroscope if has_gyroscope else None)
    odometry = odometry_for(LocalMapConfig(), known)
    results = [odometry.track(odometry.read(entry)) for entry in log.entries()]
    if has_gyroscope:
        assert all(result.node is not None for result in results)
        (note,) = odometry.gyroscope_notes()
        assert "mounting found from the log" in note
        assert "bias" in note
    entries = list(log.entries())
    other = replace(odometry.read(entries[len(entries) // 2]), stamp_ns=entries[-1].stamp_ns + 1)
    assert other.stamp_ns > results[-1].stamp_ns
    assert (odometry.track(other).node is None) == has_gyroscope
