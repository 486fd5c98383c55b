"""The synthetic world: its geometry, its images, and the paths through it."""

import cv2
import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera, ray_table
from mapper.core.geometry import angle_between, apply, inverse, transform
from mapper.simulation import (
    Boxes,
    CameraSimulator,
    Scene,
    camera_of,
    make_scene,
    read_scene,
    render,
)
from mapper.simulation.builder import ORIGIN, Builder, Skin, build_atlas
from mapper.simulation.config import SynthConfig
from mapper.simulation.path import make_motion
from tests.support.ideal_sensors import IDEAL_SENSOR

SMALL = SynthConfig(texture_px_per_m=64, width_px=160, height_px=120, sensor=IDEAL_SENSOR)
PLAIN = SMALL.model_copy(update={"texture_px_per_m": 16})
STEADY = SMALL.model_copy(update={"shake_m": 0.0, "shake_rad": 0.0})


def changed(config, **knobs):
    return config.model_copy(update=knobs)


@pytest.fixture(scope="module")
def source():
    return CameraSimulator(SMALL)


@pytest.fixture(scope="module")
def detailed():
    return CameraSimulator(changed(SMALL, width_px=320, height_px=240, texture_px_per_m=128))


@pytest.fixture(scope="module")
def some_indices(source):
    return np.linspace(0, len(source.truth) - 1, 7).astype(int)


def points_world_of(rendering, camera, T_world_camera):
    rays = ray_table(camera).reshape(-1, 2).astype(np.float64)
    z = rendering.depth_m.reshape(-1, 1).astype(np.float64)
    return apply(T_world_camera, np.hstack([rays * z, z]))


# Geometry


def test_distances_to_a_turned_box_are_exact():
    boxes = Boxes(("box",), np.array([[1.0, 2.0, 3.0]]), np.array([[2.0, 1.0, 0.5]]), np.array([np.pi / 2]))
    points = np.array([[1, 2, 3], [1, 2, 4], [1, 5, 3], [3, 2, 3], [3, 5, 3], [1, 2, 3.4]], dtype=float)

    distances_m = boxes.signed_distance_m(points)

    np.testing.assert_allclose(distances_m, [-0.5, 0.5, 1.0, 1.0, np.sqrt(2.0), -0.1], atol=1e-12)
    np.testing.assert_array_equal(boxes.occupied(points), [True, False, False, False, False, True])


def test_distances_do_not_depend_on_how_boxes_are_culled(source):
    boxes = source.scene.boxes
    points = np.random.default_rng(0).uniform([0, 0, -0.1], [9, 9, 2.7], (200, 3))
    singles = [
        Boxes(("one",), boxes.centers_world[[i]], boxes.half_sizes_m[[i]], boxes.yaws_rad[[i]])
        for i in range(len(boxes))
    ]

    nearest = np.min([single.signed_distance_m(points) for single in singles], axis=0)

    np.testing.assert_allclose(boxes.signed_distance_m(points), nearest, atol=1e-12)


def test_the_flat_has_rooms_joined_by_doors_and_things_in_every_room(source):
    plan, boxes = source.scene.plan, source.scene.boxes
    assert len(plan.rooms) == 4
    assert sum(wall.door_m is not None for wall in plan.walls) == 4
    assert {"wall", "floor", "ceiling", "door", "desk", "shelf", "books", "chair", "picture"} <= set(
        boxes.names
    )
    furniture = np.array(
        [name not in {"wall", "floor", "ceiling", "door", "picture"} for name in boxes.names]
    )
    for room in plan.rooms:
        x, y = boxes.centers_world[furniture, 0], boxes.centers_world[furniture, 1]
        inside = (room.x0_m < x) & (x < room.x1_m) & (room.y0_m < y) & (y < room.y1_m)
        assert inside.sum() > 10


def test_the_same_seed_is_the_same_flat_and_another_seed_is_not():
    once, again, other = (make_scene(changed(PLAIN, furniture_per_room=2, seed=seed)) for seed in (0, 0, 1))

    assert again.boxes.as_json() == once.boxes.as_json() != other.boxes.as_json()
    np.testing.assert_array_equal(again.atlas.texels, once.atlas.texels)


def test_boxes_without_volume_and_foreign_scene_files_are_refused(tmp_path):
    with pytest.raises(DataError, match="plate has size"):
        Boxes(("plate",), np.zeros((1, 3)), np.array([[1.0, 1.0, 0.0]]), np.zeros(1))
    (tmp_path / "scene.json").write_text('{"walls": []}')
    with pytest.raises(DataError, match="not a scene"):
        read_scene(tmp_path / "scene.json")
    with pytest.raises(DataError, match="cannot be read"):
        read_scene(tmp_path / "none.json")


# Images


def test_every_pixel_lies_on_a_surface_and_nothing_stands_before_it(source, some_indices):
    for index in some_indices:
        T_world_camera = source.truth.T_world_body[index]
        rendering = source.render(index)
        points_world = points_world_of(rendering, source.camera, T_world_camera)
        origin = T_world_camera[:3, 3]

        assert (rendering.depth_m > 0.0).all(), "the flat is closed"
        assert np.abs(source.scene.boxes.signed_distance_m(points_world)).max() < 1e-5
        for fraction in (0.3, 0.7, 0.95, 0.999):
            before = origin + fraction * (points_world - origin)
            assert not source.scene.boxes.occupied(before).any()


def test_surface_and_cosine_belong_to_the_box_that_is_seen(source):
    T_world_camera = source.truth.T_world_body[100]
    rendering, boxes = source.render(100), source.scene.boxes
    points_world = points_world_of(rendering, source.camera, T_world_camera)
    box, face = np.divmod(rendering.surface.ravel(), 6)
    cosine, sine = np.cos(boxes.yaws_rad[box]), np.sin(boxes.yaws_rad[box])
    dx, dy, dz = (points_world - boxes.centers_world[box]).T
    local = np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx, dz], axis=1)
    pixels, axis, sign = np.arange(len(box)), face // 2, 2.0 * (face % 2) - 1.0
    np.testing.assert_allclose(local[pixels, axis], sign * boxes.half_sizes_m[box, axis], atol=1e-5)

    normals = np.stack([np.stack([cosine, sine, 0 * sine], 1), np.stack([-sine, cosine, 0 * sine], 1)], 1)
    normals = np.concatenate([normals, np.tile([[[0.0, 0.0, 1.0]]], (len(box), 1, 1))], axis=1)[pixels, axis]
    rays = points_world - T_world_camera[:3, 3]
    expected = np.abs((normals * rays).sum(axis=1)) / np.linalg.norm(rays, axis=1)
    np.testing.assert_allclose(rendering.cosine.ravel(), expected, atol=1e-5)


def test_neighbouring_frames_agree_in_shape_and_colour(source):
    camera, truth = source.camera, source.truth
    for index in (50, 300, 600):
        here, there = source.render(index), source.render(index + 1)
        points_world = points_world_of(here, camera, truth.T_world_body[index])
        points_there = apply(inverse(truth.T_world_body[index + 1]), points_world)
        pixels = camera.project(points_there).astype(np.float32).reshape(*here.depth_m.shape, 2)
        inside = (pixels >= 1.0).all(axis=2)
        inside &= (pixels[..., 0] <= camera.width_px - 2) & (pixels[..., 1] <= camera.height_px - 2)
        depth_there = cv2.remap(there.depth_m, pixels, None, cv2.INTER_LINEAR)
        expected_m = points_there[:, 2].reshape(depth_there.shape)
        agrees = inside & (np.abs(depth_there - expected_m) < 0.01 * expected_m)
        seen = cv2.remap(there.rgb, pixels, None, cv2.INTER_LINEAR).astype(float)
        miss = np.abs(seen - here.rgb)[agrees]

        assert inside.mean() > 0.8
        assert agrees.sum() > 0.93 * inside.sum(), "only occlusions and edges may differ"
        assert miss.mean() < 5.0


def test_textures_are_band_limited(detailed):
    """A small image equals the average of a large one, as it would not if texture aliased."""
    large, small = (camera_of(changed(SMALL, width_px=w, height_px=3 * w // 4)) for w in (640, 80))
    T_world_camera = detailed.truth.T_world_body[200]
    fine = render(detailed.scene, large, T_world_camera).rgb
    averaged = cv2.resize(fine, (80, 60), interpolation=cv2.INTER_AREA).astype(float)

    coarse = render(detailed.scene, small, T_world_camera).rgb
    one_in_many = fine[4::8, 4::8].astype(float)

    error = np.abs(coarse - averaged).mean()
    assert error < 0.7 * np.abs(one_in_many - averaged).mean()


@pytest.mark.parametrize("side_rad", np.arange(4) * np.pi / 2)
def test_print_reads_the_right_way_round(source, side_rad):
    builder = Builder()
    image = np.zeros((64, 64, 3), dtype=np.uint8)
    image[:32, :32, 0] = 255  # red top left
    builder.box("cube", ORIGIN, low=(-0.5, -0.5, 0.5), size=(1, 1, 1), skin=Skin(builder.texture(image)))
    scene = Scene(builder.boxes(), builder.faces(), build_atlas(builder.textures), source.scene.plan)
    direction = np.array([np.cos(side_rad), np.sin(side_rad), 0.0])
    right, down = np.array([np.sin(side_rad), -np.cos(side_rad), 0.0]), np.array([0.0, 0.0, -1.0])
    T_world_camera = transform(np.column_stack([right, down, direction]), [0.0, 0.0, 1.0] - 1.5 * direction)

    seen = render(scene, source.camera, T_world_camera)

    assert seen.depth_m[60, 80] == pytest.approx(1.0, abs=1e-6)
    assert seen.rgb[50, 70, 0] > 150
    assert seen.rgb[50, 90, 0] == seen.rgb[70, 70, 0] == seen.rgb[70, 90, 0] == 0
    assert seen.depth_m[0, 0] == 0.0
    assert seen.surface[0, 0] == -1


def test_a_distorted_camera_is_refused(source):
    camera = PinholeCamera(160, 120, 130, 130, 80, 60, (0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(DataError, match="without"):
        render(source.scene, camera, np.eye(4))


# Paths


@pytest.mark.parametrize("seed", range(3))
def test_the_camera_keeps_clear_of_everything(seed):
    config = changed(PLAIN, seed=seed, rooms=4 + 2 * (seed % 2))
    scene = make_scene(config)
    for path in ("loop", "desk", "spin"):
        trajectory = CameraSimulator(changed(config, path=path), scene).truth
        assert scene.boxes.signed_distance_m(trajectory.positions_world).min() >= 0.3


def test_the_loop_visits_every_room_and_comes_back_looking_the_same_way(source):
    motion = make_motion(STEADY, source.scene)
    trajectory = CameraSimulator(STEADY, source.scene).truth
    for room in source.scene.plan.rooms:
        x, y, _ = trajectory.positions_world.T
        assert ((room.x0_m < x) & (x < room.x1_m) & (room.y0_m < y) & (y < room.y1_m)).sum() > 60

    last = trajectory.T_world_body[-1]
    begin = motion.poses(np.linspace(0.0, 3.0, 3000))
    nearest = begin[np.argmin(np.linalg.norm(begin[:, :3, 3] - last[:3, 3], axis=1))]
    assert np.linalg.norm(nearest[:3, 3] - last[:3, 3]) < 0.005
    assert angle_between(nearest[:3, :3], last[:3, :3]) < 0.01
    assert np.linalg.norm(last[:3, 3] - begin[0, :3, 3]) == pytest.approx(STEADY.overlap_m, rel=0.15)


@pytest.mark.parametrize(("path", "fastest_rad_s"), [("loop", 1.2), ("loop", 0.7), ("spin", 2.09)])
def test_the_walker_turns_no_faster_than_told_and_moves_smoothly(source, path, fastest_rad_s):
    config = changed(STEADY, path=path, max_yaw_rate_rad_s=fastest_rad_s, duration_s=30.0)
    times_s = np.arange(0.0, 30.0, 0.01)
    T_world_camera = make_motion(config, source.scene).poses(times_s)
    forward = T_world_camera[:, :3, 2]
    yaw_rate = np.diff(np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))) / 0.01
    velocity = np.diff(T_world_camera[:, :3, 3], axis=0) / 0.01
    acceleration = np.diff(velocity, axis=0) / 0.01

    assert np.abs(yaw_rate).max() <= 1.01 * fastest_rad_s
    assert np.abs(yaw_rate).max() >= 0.9 * fastest_rad_s
    assert np.linalg.norm(velocity, axis=1).max() <= 1.05 * config.speed_mps
    assert np.linalg.norm(acceleration, axis=1).max() < 4.0
    assert np.linalg.norm(np.diff(acceleration, axis=0), axis=1).max() < 0.6, "a jump in acceleration"
