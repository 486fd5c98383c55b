"""Synthetic LiDAR logs: every point lies where its scene, its sensor and its path say."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mapper.core.errors import SourceError
from mapper.core.geometry import angle_between, apply, inverse
from mapper.simulation.config import (
    COURTYARD,
    LIDAR_SCENES,
    STREET,
    LidarSensorConfig,
    LidarSynthConfig,
)
from mapper.simulation.lidar import (
    LidarSimulator,
    make_outdoor_scene,
    write_lidar_log,
)
from mapper.simulation.lidar.solids import Shape
from mapper.simulation.lidar.source import ray_directions
from mapper.simulation.path import seconds_of
from mapper.sources import open_source
from tests.support.ideal_sensors import IDEAL_LIDAR
from tests.support.street_scans import still_scan

SMALL = {"rings": 16, "lowest_ring_rad": -0.35, "highest_ring_rad": 0.25, "azimuth_steps": 180}
EXACT = IDEAL_LIDAR.model_copy(update=SMALL)
FROZEN = EXACT.model_copy(update={"motion_distortion": False})


def exact(config, **knobs):
    return config.model_copy(update={"sensor": EXACT, **knobs})


@pytest.fixture(scope="module", params=LIDAR_SCENES.values(), ids=LIDAR_SCENES)
def source(request):
    return LidarSimulator(exact(request.param))


@pytest.fixture(scope="module", params=[STREET, COURTYARD], ids=["street", "courtyard"])
def outdoors(request):
    return LidarSimulator(exact(request.param))


def distances_m(scene, points_world):
    """Return the distance of (N, 3) points from the nearest surface, to first order, without the caster."""
    hulls = scene.solids.hulls
    gap = np.abs(points_world[:, 2] - scene.ground.height_m(points_world[:, :2]))
    for shape, center, half, yaw in zip(
        scene.solids.shapes, hulls.centers_world, hulls.half_sizes_m, hulls.yaws_rad, strict=True
    ):
        cosine, sine = np.cos(yaw), np.sin(yaw)
        R_solid_world = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        local = np.abs((points_world - center) @ R_solid_world.T)
        if shape == Shape.BOX:
            outside = (local - half).max(axis=1)
        elif shape == Shape.CYLINDER:
            assert half[0] == half[1]
            outside = np.maximum(np.hypot(local[:, 0], local[:, 1]) - half[0], local[:, 2] - half[2])
        else:
            outside = (np.linalg.norm(local / half, axis=1) - 1.0) * half.max()
        gap = np.minimum(gap, np.abs(outside))
    return gap


def poses_of(source, index, scan):
    start_s = seconds_of(source.truth.stamps_ns[index : index + 1])
    return source.drive.poses(start_s + scan.times_s.astype(np.float64))


def undistorted_world(source, index, scan):
    poses = poses_of(source, index, scan)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points_body.astype(float)) + poses[:, :3, 3]


def test_undoing_the_motion_puts_every_point_on_a_surface(source):
    for index in (0, len(source.truth) // 3, len(source.truth) - 1):
        scan = source.observe(index)
        assert len(scan.points_body) > 1000
        assert distances_m(source.scene, undistorted_world(source, index, scan)).max() < 1e-4


def test_leaving_the_motion_in_does_not(outdoors):
    index = len(outdoors.truth) // 3
    scan = outdoors.observe(index)
    points_world = apply(outdoors.truth.T_world_body[index], scan.points_body.astype(float))
    assert np.percentile(distances_m(outdoors.scene, points_world), 90) > 0.02


def test_two_frozen_scans_lie_on_the_same_surfaces_by_their_true_motion(source):
    frozen = LidarSimulator(source.config.model_copy(update={"sensor": FROZEN, "rate_hz": 2.0}), source.scene)
    first, second = frozen.observe(4), frozen.observe(6)
    assert first.times_s is None
    T_world_first, T_world_second = frozen.truth.T_world_body[[4, 6]]
    points_first = apply(inverse(T_world_first) @ T_world_second, second.points_body.astype(float))
    assert distances_m(source.scene, apply(T_world_first, points_first)).max() < 1e-4
    assert np.linalg.norm(T_world_second[:3, 3] - T_world_first[:3, 3]) > 0.3


def test_the_same_seed_is_the_same_log_and_another_is_not(outdoors):
    config = outdoors.config.model_copy(update={"sensor": LidarSensorConfig(**SMALL)})
    once, again = (LidarSimulator(config) for _ in range(2))
    other = LidarSimulator(config.model_copy(update={"seed": 1}))
    late = again.observe(5)  # before the others: no scan depends on what was asked for before
    for index in (0, 5):
        np.testing.assert_array_equal(once.observe(index).points_body, again.observe(index).points_body)
    np.testing.assert_array_equal(once.observe(5).points_body, late.points_body)
    assert once.scene.solids.as_json() == again.scene.solids.as_json() != other.scene.solids.as_json()
    assert np.abs(other.truth.T_world_body[:20] - once.truth.T_world_body[:20]).max() > 0.01


def test_entries_are_the_scans_at_the_truths_stamps(source):
    entries = list(source.log().entries())
    assert [entry.stamp_ns for entry in entries] == source.truth.stamps_ns.tolist()
    assert len(entries) == len(source.log())
    scan = entries[3].load(colour=False)
    assert scan.stamp_ns == entries[3].stamp_ns
    np.testing.assert_array_equal(entries[3].scan().points_body, scan.points_body)


def test_rings_columns_and_times_are_as_configured():
    source = LidarSimulator(exact(STREET, duration_s=1.0))
    scan = source.observe(0)
    x, y, z = scan.points_body.astype(float).T
    rings = np.linspace(-0.35, 0.25, 16)
    elevation, azimuth = np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)
    assert np.abs(elevation[:, None] - rings).min(axis=1).max() < 1e-5
    assert (np.diff(scan.times_s) >= 0.0).all(), "in the order of firing"
    assert 0.0 <= scan.times_s.min() <= scan.times_s.max() < EXACT.sweep_s
    turned = (np.pi - azimuth) / (2.0 * np.pi)  # clockwise from looking back
    np.testing.assert_allclose(turned - scan.times_s / EXACT.sweep_s, 0.5 / 180, atol=1e-5)
    assert len(source.log()) == 11


@pytest.mark.parametrize(
    ("pattern", "lowest_rad", "highest_rad", "widest_rad"),
    [("rosette", -0.64, 0.64, 0.615), ("zigzag", -0.37, 0.27, np.pi)],
)
def test_patterns_that_do_not_repeat(pattern, lowest_rad, highest_rad, widest_rad):
    sensor = EXACT.model_copy(update={"pattern": pattern, "azimuth_steps": 4000})
    sweeps = np.stack([ray_directions(sensor, start_s) for start_s in (0.0, 0.1)])
    assert np.linalg.norm(sweeps, axis=-1) == pytest.approx(1.0)
    azimuth_rad = np.abs(np.arctan2(sweeps[..., 1], sweeps[..., 0]))
    elevation_rad = np.arcsin(sweeps[..., 2])
    assert azimuth_rad.max() == pytest.approx(widest_rad, abs=0.01)
    assert elevation_rad.min() == pytest.approx(lowest_rad, abs=0.02)
    assert elevation_rad.max() == pytest.approx(highest_rad, abs=0.02)
    first, second = sweeps[0].reshape(-1, 3), cKDTree(sweeps[1].reshape(-1, 3))
    assert np.median(second.query(first)[0]) > 1e-3  # rings of two sweeps are the same directions


def test_noise_dropout_and_range_are_as_configured():
    scene = make_outdoor_scene(STREET)
    T_world_lidar = LidarSimulator(STREET, scene).truth.T_world_body[0]
    sensor = FROZEN.model_copy(update={"azimuth_steps": 900})
    clean = still_scan(scene, sensor, T_world_lidar)
    noisy = still_scan(scene, sensor.model_copy(update={"range_noise_m": 0.05}), T_world_lidar)
    error_m = np.linalg.norm(noisy, axis=1) - np.linalg.norm(clean, axis=1)
    assert error_m.std() == pytest.approx(0.05, rel=0.05)
    assert abs(error_m.mean()) < 0.003
    np.testing.assert_allclose(np.cross(noisy, clean), 0.0, atol=1e-3)

    lossy = sensor.model_copy(update={"dropout_ratio": 0.3, "min_range_m": 5.0, "max_range_m": 20.0})
    left = still_scan(scene, lossy, T_world_lidar)
    ranges_m = np.linalg.norm(left, axis=1)
    in_range = np.linalg.norm(clean, axis=1)
    in_range = in_range[(in_range >= 5.0) & (in_range <= 20.0)]
    assert 4.999 < ranges_m.min() < ranges_m.max() < 20.001
    assert len(left) / len(in_range) == pytest.approx(0.7, abs=0.03)


def test_the_sensor_tilts_and_looks_around_as_far_as_told():
    steady, swinging = (
        LidarSimulator(exact(COURTYARD, tilt_rad=tilt, yaw_swing_rad=yaw)).truth.T_world_body
        for tilt, yaw in ((0.0, 0.0), (0.5, 0.8))
    )
    tilt_rad = np.arccos((steady[:, :3, 2] * swinging[:, :3, 2]).sum(axis=1))
    assert 0.45 < tilt_rad.max() <= 0.5 + 1e-9
    np.testing.assert_array_equal(steady[:, :3, 3], swinging[:, :3, 3])
    apart = [angle_between(a[:3, :3], b[:3, :3]) for a, b in zip(steady, swinging, strict=True)]
    assert 0.75 < max(apart) < 1.0


@pytest.mark.parametrize(
    ("scene", "loop_m"), [("street", 40.0), ("street", 80.0), ("street", 300.0), ("courtyard", 60.0)]
)
@pytest.mark.parametrize("seed", range(3))
def test_the_way_is_as_long_as_told_closes_and_is_free(scene, loop_m, seed):
    source = LidarSimulator(exact(STREET, scene=scene, loop_m=loop_m, seed=seed))
    route = source.scene.route
    assert route.length_m == pytest.approx(loop_m, rel=0.05)
    np.testing.assert_allclose(route.points(np.array([0.0])), route.points(np.array([route.length_m])))
    assert source.truth.path_length_m == pytest.approx(loop_m + 15.0, rel=0.05)
    T_world_body = source.truth.T_world_body
    passing = np.linalg.norm(T_world_body[0, :2, 3] - T_world_body[len(source.truth) // 2 :, :2, 3], axis=1)
    assert passing.min() < 0.5
    height_m = T_world_body[:, 2, 3] - source.scene.ground.height_m(T_world_body[:, :2, 3])
    np.testing.assert_allclose(height_m, 1.7)
    assert source.scene.solids.hulls.signed_distance_m(source.truth.positions_world).min() > 0.5


def test_rings_in_the_wrong_order_are_refused():
    with pytest.raises(ValueError, match="swap them"):
        LidarSensorConfig(lowest_ring_rad=0.2, highest_ring_rad=-0.2)


@pytest.mark.parametrize("motion_distortion", [False, True])
def test_a_written_log_reads_back_as_it_was(tmp_path, motion_distortion):
    sensor = LidarSensorConfig(**SMALL, motion_distortion=motion_distortion)
    config = COURTYARD.model_copy(update={"sensor": sensor, "duration_s": 2.0, "rate_hz": 3.0})
    told = []
    write_lidar_log(tmp_path / "log", config, on_progress=lambda done, total: told.append((done, total)))

    source, log = LidarSimulator(config), open_source(tmp_path / "log")
    assert (log.kind, log.sensor, list(log.notes)) == ("kitti", "lidar", [])
    assert told == [(done, 7) for done in range(1, 8)]
    np.testing.assert_array_equal(log.truth.stamps_ns, source.truth.stamps_ns)
    np.testing.assert_allclose(log.truth.T_world_body, source.truth.T_world_body, atol=1e-15)
    for entry, made in zip(log.entries(), source.log().entries(), strict=True):
        read, scan = entry.load(), made.load()
        assert read.stamp_ns == scan.stamp_ns
        np.testing.assert_array_equal(read.points_body, scan.points_body)
        if motion_distortion:
            np.testing.assert_allclose(read.times_s, scan.times_s, atol=1e-9)
        else:
            assert read.times_s is scan.times_s is None
    scene = json.loads((tmp_path / "log/scene.json").read_text())
    assert LidarSynthConfig(**scene["config"]) == config
    assert len(scene["solids"]) == len(source.scene.solids)
    assert {row["shape"] for row in scene["solids"]} == {"box", "cylinder", "ellipsoid"}


def test_a_log_is_not_written_over_another_and_leaves_nothing_half_done(tmp_path):
    (tmp_path / "log/mine").mkdir(parents=True)
    with pytest.raises(SourceError, match="exists already"):
        write_lidar_log(tmp_path / "log", COURTYARD)

    def give_up(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_lidar_log(tmp_path / "other", exact(COURTYARD), on_progress=give_up)
    assert [path.name for path in tmp_path.iterdir()] == ["log"]


BUSY = STREET.model_copy(update={"duration_s": 1.0, "cars": 8, "cyclists": 3, "pedestrians": 6})


def test_traffic_is_labelled_and_changes_no_other_return():
    quiet, busy = (LidarSimulator(config) for config in (STREET.model_copy(update={"duration_s": 1.0}), BUSY))

    for index in (0, 9):
        scan, moving = busy.observe_labelled(index)
        still = quiet.observe(index)
        unlabelled = {tuple(row) for row in scan.points_body[~moving].tolist()}
        assert moving.shape == (len(scan.points_body),)
        assert 0.001 < moving.mean() < 0.5
        assert unlabelled <= {tuple(row) for row in still.points_body.tolist()}


def test_traffic_moves_and_stands_on_the_ground():
    traffic = LidarSimulator(BUSY).traffic
    times_s = np.arange(0.0, 30.0, 0.1)

    for mover in traffic.movers:
        steps_m = np.abs(np.diff(mover.along_m(times_s)))
        assert steps_m.sum() > 5.0
        assert steps_m.max() < 1.0
        low, _ = mover.solids.bounds_world()
        assert -0.01 < low[:, 2].min() < 0.3


@pytest.mark.parametrize("update", [{"scene": "tunnel", "pedestrians": 1}, {"scene": "courtyard", "cars": 1}])
def test_scenes_without_room_refuse_traffic(update):
    with pytest.raises(ValueError, match="has no room for what moves"):
        LidarSynthConfig.model_validate(update)
