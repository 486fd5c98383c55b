"""The same place on another day: what is fixed stays, what is loose may not, and the light is another."""

import numpy as np
import pytest

from mapper.simulation import CameraSimulator
from mapper.simulation.config import LIDAR_SCENES, SynthConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.simulation.lidar.scene import make_outdoor_scene
from tests.support.ideal_sensors import IDEAL_LIDAR

FLAT = SynthConfig(seed=4, texture_px_per_m=16, width_px=160, height_px=120, frame_rate_hz=2.0)
STREET = LIDAR_SCENES["street"].model_copy(
    update={"seed": 4, "loop_m": 150.0, "duration_s": 1.0, "sensor": IDEAL_LIDAR}
)
LOOSE = {"chair", "table", "carton", "cup", "paper"}
MOVABLE = {"car", "bicycle", "bin"}


def solids(boxes):
    """Return the name and the rounded place and size of every box."""
    rows = np.column_stack([boxes.centers_world, boxes.half_sizes_m, boxes.yaws_rad]).round(6)
    return {(name, *row) for name, row in zip(boxes.names, rows.tolist(), strict=True)}


def another(config, day=1):
    return config.model_copy(update={"day": day})


def test_only_loose_furniture_of_a_flat_has_moved():
    first, second = (CameraSimulator(config) for config in (FLAT, another(FLAT)))
    before, after = solids(first.scene.boxes), solids(second.scene.boxes)
    gone, come = {name for name, *_ in before - after}, {name for name, *_ in after - before}
    assert "chair" in gone
    assert gone == come
    assert gone <= LOOSE
    assert second.scene.boxes.signed_distance_m(second.truth.positions_world).min() >= 0.2


def test_the_light_and_the_walk_are_others():
    first, second = (CameraSimulator(config) for config in (FLAT, another(FLAT)))
    assert not np.allclose(first.scene.faces.shades, second.scene.faces.shades)
    count = min(len(first.truth), len(second.truth))
    apart = first.truth.T_world_body[:count, :3, :3] - second.truth.T_world_body[:count, :3, :3]
    assert np.abs(apart).max() > 0.1


def test_cars_have_left_a_street_and_houses_have_not():
    before, after = (make_outdoor_scene(config).solids.hulls for config in (STREET, another(STREET)))
    gone = {name for name, *_ in solids(before) - solids(after)}
    assert "car" in gone
    assert gone <= MOVABLE
    assert 0 < after.names.count("car") < before.names.count("car")


def test_the_other_line_of_the_lane_is_free():
    first, second = (LidarSimulator(config) for config in (STREET, another(STREET)))
    apart_m = np.linalg.norm(first.truth.positions_world - second.truth.positions_world, axis=1)
    assert 0.05 < apart_m.max() < 0.6
    distance_m = second.scene.solids.hulls.signed_distance_m(second.truth.positions_world)
    assert distance_m.min() > 0.5


@pytest.mark.parametrize("day", [1, 2])
def test_a_day_is_the_same_every_time(day):
    first, second = (LidarSimulator(another(STREET, day)).observe(0) for _ in range(2))
    np.testing.assert_array_equal(first.points_body, second.points_body)
    other = LidarSimulator(another(STREET, day + 1)).observe(0)
    assert first.points_body.shape != other.points_body.shape or not np.array_equal(
        first.points_body, other.points_body
    )
