"""Maps compared with clouds, other maps and known worlds, and judged by their own sharpness."""

import json

import numpy as np
import pytest

from mapper.core.errors import DataError, MapperError
from mapper.core.geometry import apply, exp, inverse, transform
from mapper.evaluators.metrics.map_quality import DistanceTo
from mapper.evaluators.metrics.map_reference import (
    check_occupancy,
    outdoor_distance_m,
    read_reference,
    scene_distance,
)
from mapper.evaluators.metrics.occupancy import assess_by_points, check_metrics
from mapper.evaluators.metrics.sharpness import Views, sharpness_metrics
from mapper.evaluators.pictures.errors import write_map_errors
from mapper.export.mesh_files import write_ply
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.octree.octomap_file import write_bt
from mapper.simulation.boxes import Boxes, write_scene
from mapper.simulation.config import LidarSynthConfig
from mapper.simulation.lidar import make_outdoor_scene
from tests.support.ideal_sensors import IDEAL_LIDAR
from tests.support.street_scans import still_scan

EDGE_M = 0.05
ROW = np.arange(-1.0, 1.0, 0.02) + 0.01


def wall(at_x_m, *, along=ROW):
    """Points of a face across x."""
    y, z = (axis.ravel() for axis in np.meshgrid(along, ROW))
    return np.column_stack([np.full(len(y), at_x_m), y, z])


def mapped(*faces, resolution_m=EDGE_M):
    octree = OctreeMap(OctreeConfig(resolution_m=resolution_m))
    for face in faces:
        octree.insert_points(face.astype(np.float32), np.zeros(3))
    return octree


def scores(octree, points, **options):
    metrics = check_metrics(assess_by_points(octree, points, **options))
    return {metric.name.split(",")[0]: metric.value for metric in metrics}


PRECISION, RECALL, F_SCORE = "occupied precision", "occupied recall where the map looked", "occupied F-score"
WHOLE = "occupied recall of the whole reference"


def test_a_cloud_of_the_same_wall_is_met_and_one_elsewhere_is_not():
    octree = mapped(wall(2.02))
    assert scores(octree, wall(2.02)) == {PRECISION: 1.0, RECALL: 1.0, F_SCORE: 1.0}
    assert scores(octree, wall(2.06)) == {PRECISION: 1.0, RECALL: 1.0, F_SCORE: 1.0}
    before = scores(octree, wall(1.82))  # the map looked through there
    assert before[PRECISION] == before[RECALL] == before[F_SCORE] == 0.0
    with pytest.raises(DataError, match="share no known surface"):
        scores(octree, wall(2.4))  # behind it, where nobody looked


def test_what_was_never_seen_is_not_missed_but_told():
    half = mapped(wall(2.02, along=ROW[ROW < 0.0]))
    values = scores(half, wall(2.02))
    assert values[PRECISION] == 1.0
    assert values[RECALL] > 0.97
    assert values[WHOLE] == pytest.approx(0.5, abs=0.04)


@pytest.mark.parametrize("resolution_m", [0.05, 0.1, 0.025])
def test_a_map_meets_itself_at_any_resolution(resolution_m, tmp_path):
    write_bt(tmp_path / "other.bt", mapped(wall(2.02), resolution_m=resolution_m))
    reference = read_reference(tmp_path / "other.bt", voxel_m=EDGE_M)
    octree = mapped(wall(2.02))

    verdict = check_occupancy(octree, reference, np.eye(4), voxels=1)

    values = {metric.name.split(",")[0]: metric.value for metric in check_metrics(verdict)}
    assert values[PRECISION] == values["free precision"] == 1.0
    assert min(values[RECALL], values["free recall"]) > 0.99


def test_a_map_too_coarse_to_be_cut_up_is_refused(tmp_path, monkeypatch):
    write_bt(tmp_path / "coarse.bt", mapped(wall(2.02), resolution_m=0.1))
    monkeypatch.setattr("mapper.evaluators.metrics.map_reference._MOST_POINTS", 1000)
    with pytest.raises(DataError, match=r"voxels of 0.1 m are too coarse for a map of 0.05 m"):
        read_reference(tmp_path / "coarse.bt", voxel_m=EDGE_M)


def test_a_reference_is_laid_where_it_is_said_to_lie(tmp_path):
    T_map_reference = exp(np.array([0.0, 0.0, 0.4]), np.array([0.5, -0.2, 0.1]))
    points = wall(2.02) @ inverse(T_map_reference)[:3, :3].T + inverse(T_map_reference)[:3, 3]
    write_ply(tmp_path / "wall.ply", points.astype(np.float32), np.zeros(points.shape, np.uint8))
    reference = read_reference(tmp_path / "wall.ply", voxel_m=EDGE_M)
    octree = mapped(wall(2.02))

    laid = check_metrics(check_occupancy(octree, reference, T_map_reference, voxels=1))
    lost = check_metrics(check_occupancy(octree, reference, transform(np.eye(3), [0.3, 0.0, 0.0]), voxels=1))

    assert min(metric.value for metric in laid) > 0.97
    assert lost[0].value < 0.6


def test_a_doubled_map_scores_lower_and_its_picture_shows_the_copy(tmp_path):
    once, twice = mapped(wall(2.02)), mapped(wall(1.82), wall(2.02))
    assert scores(once, wall(2.02))[F_SCORE] == 1.0
    assert scores(twice, wall(2.02))[F_SCORE] < 0.8
    verdict = assess_by_points(twice, wall(2.02))
    agreed, extra, missing = verdict.centres_world
    assert np.unique(extra[:, 0].round(3)).tolist() == [1.825]
    assert len(agreed) + len(extra) == len(verdict.occupied)
    assert len(missing) == 0
    picture = write_map_errors(tmp_path / "plots", verdict, title="twice")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_is_no_reference_is_named(tmp_path):
    (tmp_path / "notes.md").write_text("a map\n")
    (tmp_path / "scene.json").write_text("{}\n")
    (tmp_path / "empty").mkdir()
    for path, message in (
        (tmp_path / "empty", "empty: has neither map.octree nor scene.json"),
        (tmp_path / "nowhere.ply", "no such reference"),
        (tmp_path / "notes.md", "want a cloud"),
        (tmp_path, "not a scene of `mapper synth`"),
    ):
        with pytest.raises(MapperError, match=message):
            read_reference(path, voxel_m=EDGE_M)


@pytest.mark.parametrize("kind", ["street", "courtyard"])
def test_points_of_an_outdoor_world_lie_on_its_surfaces(kind):
    config = LidarSynthConfig(scene=kind, loop_m=30.0)
    scene = make_outdoor_scene(config)
    here = scene.route.points(np.zeros(1))
    eye = np.array([*here[0], float(scene.ground.height_m(here)[0]) + 2.0])
    points = still_scan(scene, IDEAL_LIDAR, transform(np.eye(3), eye))[::10].astype(np.float64) + eye
    away = scene.ground.normals(points[:, :2])

    assert len(points) > 500
    assert np.abs(outdoor_distance_m(scene, points)).max() < 1e-5
    sunk = outdoor_distance_m(scene, points - 0.05 * away)
    near_ground = np.abs(points[:, 2] - scene.ground.height_m(points[:, :2])) < 1e-4
    np.testing.assert_allclose(sunk[near_ground], -0.05, atol=2e-3)
    assert outdoor_distance_m(scene, np.array([[0.0, 0.0, 500.0]]))[0] > 400.0


def test_scenes_of_both_kinds_are_read_from_their_files(tmp_path):
    outdoors = LidarSynthConfig(scene="courtyard", loop_m=40.0)
    (tmp_path / "yard.json").write_text(
        json.dumps({"config": outdoors.model_dump(mode="json"), "ground": {}, "solids": []})
    )
    scene = make_outdoor_scene(outdoors)
    probes = np.random.default_rng(0).uniform(-10.0, 10.0, (50, 3))
    np.testing.assert_array_equal(
        scene_distance(tmp_path / "yard.json")(probes), outdoor_distance_m(scene, probes)
    )
    boxes = Boxes(("wall",), np.array([[2.0, 0.0, 1.0]]), np.array([[0.1, 2.0, 1.0]]), np.array([0.3]))
    write_scene(tmp_path / "flat.json", boxes, {})
    np.testing.assert_array_equal(
        scene_distance(tmp_path / "flat.json")(probes), boxes.signed_distance_m(probes)
    )


def seen_wall(*, sigma_m, apart_m=0.0, frames=4, towards=-1.0, seed=0):
    """A wall across x seen in several frames, every second of which lays it a distance further away."""
    rng = np.random.default_rng(seed)
    points, numbers = [], []
    for frame in range(frames):
        face = wall(2.0 + apart_m * (frame % 2))[:: frames // 2 or 1]
        points.append(face + rng.normal(0.0, sigma_m, face.shape) * (1.0, 0.0, 0.0))
        numbers.append(np.full(len(face), frame))
    points = np.concatenate(points)
    directions = np.tile((towards, 0.0, 0.0), (len(points), 1))
    return Views(points, directions, np.concatenate(numbers))


def sharp(views):
    return {metric.name.split(",")[0]: metric.value for metric in sharpness_metrics(views, radius_m=0.2)}


def test_thickness_is_the_noise_and_grows_with_it():
    values = [sharp(seen_wall(sigma_m=sigma_m)) for sigma_m in (0.002, 0.01, 0.02, 0.05)]
    thickness_m = [value["wall thickness median"] for value in values]
    assert thickness_m[:2] == pytest.approx([0.002, 0.01], rel=0.1)
    for name in (
        "wall thickness median",
        "wall thickness quartile",
        "mean map entropy",
        "mean plane variance",
    ):
        assert (np.diff([value[name] for value in values]) > 0.0).all(), name
    assert all(value["double walls"] < 2.0 for value in values)


def test_a_wall_laid_twice_is_thicker_and_called_double():
    once, twice = sharp(seen_wall(sigma_m=0.005)), sharp(seen_wall(sigma_m=0.005, apart_m=0.08))
    assert once["double walls"] == 0.0
    assert twice["double walls"] > 90.0
    assert twice["wall thickness median"] == pytest.approx(0.04, rel=0.1)
    assert twice["mean map entropy"] > once["mean map entropy"] + 1.0


def test_the_two_faces_of_a_thin_wall_are_no_double_wall():
    front, back = seen_wall(sigma_m=0.005), seen_wall(sigma_m=0.005, towards=1.0, seed=1)
    both = Views(
        np.concatenate([front.points_world, back.points_world + np.array([0.08, 0.0, 0.0])]),
        np.concatenate([front.towards_world, back.towards_world]),
        np.concatenate([front.frames, back.frames]),
    )
    values = sharp(both)
    assert values["double walls"] == 0.0
    assert values["wall thickness median"] == pytest.approx(0.005, rel=0.1)


def test_scans_that_share_nothing_cannot_tell():
    with pytest.raises(DataError, match="no overlap"):
        sharp(seen_wall(sigma_m=0.01, frames=1))
    with pytest.raises(DataError, match=r"want \(N, 3\)"):
        Views(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.int64))


def test_mean_and_median_are_those_of_every_distance_told_by_brute_force():
    rng = np.random.default_rng(0)
    target, source = rng.normal(size=(300, 3)), rng.normal(0.3, 1.0, size=(200, 3))
    source[:30] += 50.0  # what only one saw moves the mean, not the median
    T_target_source = exp(np.array([0.1, -0.2, 1.0]), np.array([3.0, 1.0, -2.0]))
    nearest = np.linalg.norm(source[:, None] - target[None], axis=2).min(axis=1)
    moved = apply(inverse(T_target_source), source)

    distance = DistanceTo(target.astype(np.float32)).of(moved.astype(np.float32), T_target_source)

    assert distance.mhd_m == pytest.approx(nearest.mean(), abs=1e-5)
    assert distance.mpd_m == pytest.approx(np.median(nearest), abs=1e-5)


def test_an_empty_cloud_on_either_side_is_an_error():
    points, none = np.ones((5, 3), np.float32), np.empty((0, 3), np.float32)
    with pytest.raises(DataError, match="no points"):
        DistanceTo(none)
    with pytest.raises(DataError, match="the source has no points"):
        DistanceTo(points).of(none, np.eye(4))
