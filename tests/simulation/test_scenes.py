"""Scenes beside the flat, of camera and LiDAR, and the same places on another day."""

import numpy as np
import pytest
from pydantic import ValidationError

from mapper.simulation import CameraSimulator, render
from mapper.simulation.config import CAMERA_SCENES, LIDAR_SCENES, SynthConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.simulation.lidar.scene import make_outdoor_scene
from mapper.simulation.lidar.things import STOREY_M
from mapper.simulation.path import seconds_of
from mapper.simulation.plan import TWIN_DISTANCE_M
from tests.support.ideal_sensors import IDEAL_LIDAR, IDEAL_SENSOR

SMALL = {"texture_px_per_m": 16, "width_px": 160, "height_px": 120, "sensor": IDEAL_SENSOR}


def simulated(name, **knobs):
    return CameraSimulator(CAMERA_SCENES[name].model_copy(update={**SMALL, **knobs}))


@pytest.mark.parametrize("name", CAMERA_SCENES)
@pytest.mark.parametrize("seed", [0, 5])
def test_every_scene_is_closed_and_the_way_through_it_is_free(name, seed):
    source = simulated(name, seed=seed)
    assert source.scene.boxes.signed_distance_m(source.truth.positions_world).min() >= 0.3
    for index in np.linspace(0, len(source.truth) - 1, 6).astype(int):
        assert (source.render(int(index)).depth_m > 0.0).all(), "every ray meets something"


@pytest.mark.parametrize(("name", "share"), [("corridor", 0.35), ("hall", 0.55), ("flat", 0.3)])
def test_in_corridor_and_hall_much_lies_farther_off_than_in_rooms(name, share):
    source = simulated(name)
    frames = np.linspace(0, len(source.truth) - 1, 10).astype(int)
    far = np.mean([(source.render(int(index)).depth_m > 4.0).mean() for index in frames])
    assert far > share if name != "flat" else far < share


def test_a_hall_keeps_its_clearance_and_refuses_one_without_a_way():
    source = simulated("hall", furniture_per_room=0)
    (room,) = source.scene.plan.rooms
    x, y, _ = source.truth.positions_world.T
    gaps_m = np.minimum.reduce([x - room.x0_m, room.x1_m - x, y - room.y0_m, room.y1_m - y])
    assert 4.0 < gaps_m.min() < 5.5
    with pytest.raises(ValidationError, match="leaves no way"):
        SynthConfig(scene="hall", hall_width_m=9.0, hall_clearance_m=4.5)
    with pytest.raises(ValidationError, match="has no desk"):
        SynthConfig(scene="hall", path="desk")


def test_twin_rooms_look_alike_to_the_last_pixel_but_through_the_door():
    source = simulated("twin-rooms")
    first, second, corridor = source.scene.plan.rooms
    shift = np.array([TWIN_DISTANCE_M, 0.0, 0.0])

    def inside(room):
        x, y, _ = source.truth.positions_world.T
        return np.flatnonzero((room.x0_m < x) & (x < room.x1_m) & (room.y0_m < y) & (y < room.y1_m))

    assert all(len(inside(room)) > 50 for room in (first, second, corridor)), "the way visits all three"
    shares = []
    for index in inside(first)[::60]:
        T_world_camera = source.truth.T_world_body[index].copy()
        here = render(source.scene, source.camera, T_world_camera)
        T_world_camera[:3, 3] += shift
        there = render(source.scene, source.camera, T_world_camera)
        in_the_room = first.y0_m + 0.05 < world_y_of(here, source, source.truth.T_world_body[index])
        shares.append(in_the_room.mean())
        assert (here.rgb == there.rgb).all(axis=2)[in_the_room].mean() > 0.98
        np.testing.assert_allclose(here.depth_m[in_the_room], there.depth_m[in_the_room], atol=1e-4)
    assert np.mean(shares) > 0.5


def world_y_of(rendering, source, T_world_camera):
    """Return each pixel's world y, metres."""
    rows, columns = np.indices(rendering.depth_m.shape)
    camera = source.camera
    rays = np.stack(
        [(columns - camera.cx_px) / camera.fx_px, (rows - camera.cy_px) / camera.fy_px, np.ones(rows.shape)],
        axis=2,
    )
    return (rays * rendering.depth_m[:, :, None]) @ T_world_camera[1, :3] + T_world_camera[1, 3]


def test_a_white_room_has_shape_but_no_image():
    frame = simulated("white-room").render(30)
    assert frame.rgb.reshape(-1, 3).std(axis=0).max() < 1.5
    assert frame.depth_m.std() > 0.2
    grey = simulated("white-room", texture_contrast=0.5).render(30)
    assert grey.rgb.std() > 5.0


@pytest.fixture(scope="module")
def tunnel():
    return LidarSimulator(LIDAR_SCENES["tunnel"])


def test_a_tunnel_looks_the_same_along_its_axis_until_its_end_comes_near(tunnel):
    reach = tunnel.config.sensor.model_copy(update={"max_range_m": 25.0, "range_noise_m": 0.0})
    short = LidarSimulator(tunnel.config.model_copy(update={"sensor": reach}), tunnel.scene)
    ends_m = np.abs(short.truth.positions_world[:, 0])
    middle = [i for i in range(len(ends_m)) if ends_m[i] < 20.0][:20:19]
    for index in middle:
        points = short.observe(index).points_body
        normals_along = np.abs(points[:, 0]) > 24.9
        assert normals_along.mean() < 0.02
        assert np.ptp(points[:, 0]) > 40.0
    assert ends_m[0] > 0.4 * tunnel.scene.route.size_m[0], "the way begins near an end"


def test_stairs_rise_a_storey_a_lap_without_a_jump_and_above_the_steps():
    stairs = LidarSimulator(LIDAR_SCENES["staircase"])
    heights_m = stairs.truth.positions_world[:, 2]
    assert heights_m[-1] - heights_m[0] == pytest.approx(3.0 * STOREY_M, abs=0.5)
    assert np.abs(np.diff(heights_m)).max() < 0.15
    hulls = stairs.scene.solids.hulls
    assert hulls.signed_distance_m(stairs.truth.positions_world).min() > 0.3
    below = stairs.truth.positions_world - [0.0, 0.0, stairs.config.mount_height_m + 0.2]
    on_solid = hulls.signed_distance_m(below) < 0.2
    assert on_solid.mean() > 0.95, "there is a step or a landing under every pose"


def test_a_field_has_few_things_and_a_flat_is_the_cameras():
    field, street = (LidarSimulator(LIDAR_SCENES[name]) for name in ("field", "street"))
    assert 6 <= len(field.scene.solids) < 30 < len(street.scene.solids)
    rooms = LidarSimulator(LIDAR_SCENES["flat"])
    flat = CameraSimulator(SynthConfig(seed=rooms.config.seed, texture_px_per_m=16)).scene.boxes
    np.testing.assert_array_equal(rooms.scene.solids.hulls.centers_world, flat.centers_world)
    seconds = seconds_of(rooms.truth.stamps_ns)
    np.testing.assert_allclose(np.diff(seconds), 1.0 / rooms.config.rate_hz)


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
