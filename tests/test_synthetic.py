"""The synthetic world: its geometry, images, sensor, paths and logs."""

import json
import tomllib

import cv2
import numpy as np
import pytest

from mapper.config.synthetic import IDEAL_SENSOR, SensorConfig, SynthConfig
from mapper.errors import DataError, SourceError
from mapper.frames import PinholeCamera, ray_table
from mapper.geometry import angle_between, apply, inverse, transform
from mapper.sources import open_source
from mapper.sources.synthetic import (
    Boxes,
    Rendering,
    Scene,
    SyntheticSource,
    camera_of,
    make_path,
    make_scene,
    observe,
    read_scene,
    render,
    write_tum_log,
)
from mapper.sources.synthetic.atlas import build_atlas
from mapper.sources.synthetic.builder import ORIGIN, Builder, Skin
from mapper.sources.synthetic.path import START_NS, make_motion, seconds_of
from mapper.sources.synthetic.sensor import BASELINE_M, DISPARITY_FOCAL_PX, axial_sigma_m
from mapper.timebase import NS_PER_S
from mapper.trajectory import read_tum

SMALL = SynthConfig(texture_px_per_m=64, width_px=160, height_px=120, sensor=IDEAL_SENSOR)
PLAIN = SMALL.model_copy(update={"texture_px_per_m": 16})
STEADY = SMALL.model_copy(update={"shake_m": 0.0, "shake_rad": 0.0})


def changed(config, **knobs):
    return config.model_copy(update=knobs)


@pytest.fixture(scope="module")
def source():
    return SyntheticSource(SMALL)


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
    once, again, other = (make_scene(config) for config in (PLAIN, PLAIN, changed(PLAIN, seed=1)))

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


def test_textures_are_band_limited(source):
    """A small image equals the average of a large one, as it would not if texture aliased."""
    fine_camera = camera_of(changed(SMALL, width_px=640, height_px=480))
    T_world_camera = source.truth.T_world_body[200]
    fine = render(source.scene, fine_camera, T_world_camera).rgb
    averaged = cv2.resize(fine, (160, 120), interpolation=cv2.INTER_AREA).astype(float)

    coarse = render(source.scene, source.camera, T_world_camera).rgb
    one_in_sixteen = fine[2::4, 2::4].astype(float)

    error = np.abs(coarse - averaged).mean()
    assert error < 5.0
    assert error < 0.7 * np.abs(one_in_sixteen - averaged).mean()


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


def test_orb_finds_features_everywhere():
    config = changed(SMALL, width_px=320, height_px=240, texture_px_per_m=128)
    source = SyntheticSource(config)
    orb = cv2.ORB_create(2000, fastThreshold=20)
    for index in np.linspace(0, len(source.truth) - 1, 15).astype(int):
        gray = cv2.cvtColor(source.render(index).rgb, cv2.COLOR_RGB2GRAY)
        assert len(orb.detect(gray)) > 250


def test_a_distorted_camera_is_refused(source):
    camera = PinholeCamera(160, 120, 130, 130, 80, 60, (0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(DataError, match="without"):
        render(source.scene, camera, np.eye(4))


# Paths


@pytest.mark.parametrize("seed", range(4))
def test_the_camera_keeps_clear_of_everything(seed):
    config = changed(PLAIN, seed=seed, rooms=4 + 2 * (seed % 2))
    scene = make_scene(config)
    for path in ("loop", "desk", "spin"):
        trajectory = make_path(changed(config, path=path), scene)
        assert scene.boxes.signed_distance_m(trajectory.positions_world).min() >= 0.3


def test_the_loop_visits_every_room_and_comes_back_looking_the_same_way(source):
    motion = make_motion(STEADY, source.scene)
    trajectory = make_path(STEADY, source.scene)
    for room in source.scene.plan.rooms:
        x, y, _ = trajectory.positions_world.T
        assert ((room.x0_m < x) & (x < room.x1_m) & (room.y0_m < y) & (y < room.y1_m)).sum() > 60

    last = trajectory.T_world_body[-1]
    begin = motion.poses(np.linspace(0.0, 3.0, 3000))
    nearest = begin[np.argmin(np.linalg.norm(begin[:, :3, 3] - last[:3, 3], axis=1))]
    assert np.linalg.norm(nearest[:3, 3] - last[:3, 3]) < 0.005
    assert angle_between(nearest[:3, :3], last[:3, :3]) < 0.01
    assert np.linalg.norm(last[:3, 3] - begin[0, :3, 3]) == pytest.approx(STEADY.overlap_m, rel=0.15)


def test_three_laps_are_three_times_as_long(source):
    once, thrice = (make_path(changed(STEADY, laps=laps), source.scene).path_length_m for laps in (1.0, 3.0))
    assert thrice - STEADY.overlap_m == pytest.approx(3.0 * (once - STEADY.overlap_m), rel=1e-3)
    assert thrice > 55.0


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


def test_stamps_are_whole_frames_from_the_start(source):
    trajectory = make_path(changed(STEADY, path="desk", duration_s=2.0), source.scene)
    assert len(trajectory) == 61
    assert trajectory.stamps_ns[0] == START_NS
    assert trajectory.stamps_ns[30] == START_NS + NS_PER_S
    assert seconds_of(trajectory.stamps_ns)[-1] == 2.0


# Sensor


def flat(depth_m, *, width=320, height=240):
    shape = (height, width)
    depth = np.full(shape, depth_m, dtype=np.float32)
    gray = np.full((*shape, 3), 128, dtype=np.uint8)
    return Rendering(gray, depth, np.zeros(shape, np.int32), np.ones(shape, np.float32))


@pytest.mark.parametrize("depth_m", [0.8, 1.5, 3.0])
def test_depth_noise_follows_nguyen(depth_m):
    sensor = changed(IDEAL_SENSOR, axial_noise_ratio=1.0)
    seen = [
        observe(flat(depth_m), focal_px=262, sensor=sensor, rng=np.random.default_rng(i)) for i in range(5)
    ]
    errors_m = np.array([depth for _, depth in seen]) - depth_m

    sigma_m = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    assert float(axial_sigma_m(np.array(depth_m))) == pytest.approx(sigma_m)
    assert errors_m.std() == pytest.approx(sigma_m, rel=0.05)
    assert abs(errors_m.mean()) < 0.1 * sigma_m
    neighbours = np.corrcoef(errors_m[:, :, 1:].ravel(), errors_m[:, :, :-1].ravel())[0, 1]
    assert 0.3 < neighbours < 0.55, "half of the variance comes in patches"


def test_depth_comes_in_eighths_of_a_pixel_of_disparity():
    sensor = SensorConfig(dropout_ratio=0.0)
    _, depth_m = observe(flat(2.5), focal_px=262, sensor=sensor, rng=np.random.default_rng(0))
    eighths = 8.0 * BASELINE_M * DISPARITY_FOCAL_PX / depth_m.astype(float)

    np.testing.assert_allclose(eighths, np.rint(eighths), atol=1e-3)
    assert 2 < len(np.unique(depth_m)) < 12


def test_no_depth_too_near_too_far_or_at_a_slant():
    kinect = SensorConfig()

    def share(rendering):
        _, depth_m = observe(rendering, focal_px=262, sensor=kinect, rng=np.random.default_rng(0))
        return (depth_m > 0.0).mean()

    assert share(flat(0.39)) == share(flat(8.1)) == 0.0
    assert share(flat(2.0)) > 0.99
    assert 0.2 < share(flat(6.5)) < 0.8
    steep = flat(2.0)
    steep.cosine[:] = 0.05
    assert share(steep) < 0.1


def test_a_near_thing_throws_a_shadow_to_its_left():
    rendering = flat(3.0)
    rendering.depth_m[:, 150:] = 1.0
    focal_px = 400.0
    shadow_px = focal_px * BASELINE_M * (1.0 / 1.0 - 1.0 / 3.0)

    _, depth_m = observe(rendering, focal_px=focal_px, sensor=SensorConfig(), rng=np.random.default_rng(0))

    valid = (depth_m > 0.0).mean(axis=0)
    assert (valid[round(150 - shadow_px) + 1 : 149] == 0.0).all()
    assert (valid[: round(150 - shadow_px) - 2] > 0.9).all()
    assert (valid[155:] > 0.9).all()


def test_image_noise_has_its_size_and_no_bias():
    sensor = changed(IDEAL_SENSOR, image_noise_levels=3.0)
    image, _ = observe(flat(2.0), focal_px=262, sensor=sensor, rng=np.random.default_rng(0))
    assert image.std() == pytest.approx(3.0, rel=0.05)
    assert image.mean() == pytest.approx(128.0, abs=0.05)


def test_an_ideal_sensor_changes_nothing(source):
    rendering = source.render(40)
    image, depth_m = observe(rendering, focal_px=131, sensor=IDEAL_SENSOR, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(image, rendering.rgb)
    np.testing.assert_array_equal(depth_m, rendering.depth_m)


def test_exposure_blurs_what_moves_and_leaves_depth_alone(source):
    spin = changed(SMALL, path="spin", max_yaw_rate_rad_s=2.0)
    sharp = SyntheticSource(spin, source.scene).render(30)
    exposed = changed(spin, sensor=changed(IDEAL_SENSOR, exposure_s=0.03))
    blurred = SyntheticSource(exposed, source.scene).render(30)

    def contrast(rgb):
        return np.abs(np.diff(rgb.astype(float), axis=1)).mean()

    assert contrast(blurred.rgb) < 0.8 * contrast(sharp.rgb)
    assert blurred.rgb.mean() == pytest.approx(sharp.rgb.mean(), rel=0.05)
    np.testing.assert_array_equal(blurred.depth_m, sharp.depth_m)


# Logs


def test_a_frame_does_not_depend_on_the_others(source):
    config = changed(SMALL, sensor=SensorConfig())
    noisy = SyntheticSource(config, source.scene)
    entries = list(noisy.entries())
    alone = list(SyntheticSource(config, source.scene).entries())[20].load()
    for entry in entries[18:20]:
        entry.load()
    after_others = entries[20].load()

    np.testing.assert_array_equal(alone.image, after_others.image)
    np.testing.assert_array_equal(alone.depth_m, after_others.depth_m)
    assert (entries[21].load().image != alone.image).any()
    assert entries[20].load(colour=False).image.ndim == 2


def test_dropped_frames_are_missing_and_a_covered_lens_is_black(source):
    config = changed(SMALL, drop_ratio=0.2, blackout_start_s=1.0, blackout_duration_s=0.5)
    lossy = SyntheticSource(config, source.scene)
    entries = list(lossy.entries())

    assert len(entries) == len(lossy)
    assert 0.74 < len(lossy) / len(source) < 0.86
    for entry in entries[::4][:20]:
        seconds = seconds_of(np.array([entry.stamp_ns]))[0]
        frame = entry.load()
        assert (frame.image.max() == 0) == (frame.depth_m.max() == 0.0) == (1.0 <= seconds < 1.5)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    out = tmp_path_factory.mktemp("synthetic") / "log"
    config = changed(PLAIN, duration_s=0.3, sensor=SensorConfig())
    seen = []
    write_tum_log(out, config, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i, 10) for i in range(1, 11)]
    return out, SyntheticSource(config)


def test_the_folder_reads_back_as_the_source_in_memory(log):
    out, source = log
    opened = open_source(out)

    assert opened.kind == "tum"
    assert list(opened.notes) == []
    assert len(opened) == len(source) == 10
    for written, made in zip(opened.entries(), source.entries(), strict=True):
        frame, expected = written.load(), made.load()
        assert frame.stamp_ns == expected.stamp_ns
        assert frame.camera == expected.camera
        np.testing.assert_array_equal(frame.image, expected.image)
        np.testing.assert_allclose(frame.depth_m, expected.depth_m, atol=1.01e-4)


def test_truth_calibration_and_scene_are_exact(log):
    out, source = log
    truth = read_tum(out / "groundtruth.txt")
    calibration = tomllib.loads((out / "calibration.toml").read_text())

    np.testing.assert_array_equal(truth.stamps_ns, source.truth.stamps_ns)
    np.testing.assert_allclose(truth.T_world_body, source.truth.T_world_body, atol=1e-14)
    assert calibration["fx_px"] == source.camera.fx_px
    assert calibration["depth_factor"] == 5000.0
    assert read_scene(out / "scene.json").as_json() == source.scene.boxes.as_json()
    assert SynthConfig(**json.loads((out / "scene.json").read_text())["config"]) == source.config


def test_the_same_configuration_writes_the_same_bytes(log, tmp_path):
    out, source = log
    write_tum_log(tmp_path / "again", source.config)
    files = sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file())
    assert len(files) == 25
    for file in files:
        assert (out / file).read_bytes() == (tmp_path / "again" / file).read_bytes()


def test_colour_can_be_jpeg(tmp_path):
    config = changed(PLAIN, duration_s=0.04, image_format="jpg", path="desk")
    write_tum_log(tmp_path / "log", config)
    assert len(list((tmp_path / "log/rgb").glob("*.jpg"))) == 2
    assert len(list(open_source(tmp_path / "log").entries())) == 2


def test_an_existing_folder_is_refused_and_a_failure_leaves_nothing(log, tmp_path):
    out, source = log
    with pytest.raises(SourceError, match="exists already"):
        write_tum_log(out, source.config)

    def stop(_done, _total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_tum_log(tmp_path / "log", source.config, on_progress=stop)
    assert list(tmp_path.iterdir()) == []
