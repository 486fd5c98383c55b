"""A second LiDAR whose mounting is stated wrongly."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.mapping.sensor_agreement import mounting_warnings
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.sources.base import SensorBeside

STREET = LidarSynthConfig(
    seed=74, loop_m=120.0, duration_s=5.0, sensor=LidarSensorConfig(rings=24, azimuth_steps=450)
)
RAISED_M = 0.4


@pytest.fixture(scope="module")
def two_lidars():
    raised = STREET.model_copy(update={"mount_height_m": STREET.mount_height_m + RAISED_M})
    return LidarSimulator(STREET).log(), LidarSimulator(raised).log()


def warnings_of(two_lidars, *, turned_deg=0.0, moved_m=0.0):
    tracked, second = two_lidars
    stated = exp(np.radians([0.0, 0.0, turned_deg]), np.array([moved_m, 0.0, RAISED_M]))
    log = replace(tracked, beside=[SensorBeside(second, stated)])
    return mounting_warnings(log, tracked.truth, voxel_m=0.4)


def test_a_right_mounting_is_not_doubted(two_lidars):
    assert warnings_of(two_lidars) == []


@pytest.mark.parametrize(("turned_deg", "moved_m"), [(0.0, 0.3), (3.0, 0.0), (8.0, 0.5)])
def test_a_wrong_mounting_is_named_with_its_error(two_lidars, turned_deg, moved_m):
    (warning,) = warnings_of(two_lidars, turned_deg=turned_deg, moved_m=moved_m)
    numbers = [float(number) for number in re.findall(r"\d+\.\d+(?= m|°)", warning)]
    assert numbers == pytest.approx([moved_m, turned_deg], abs=0.05)
