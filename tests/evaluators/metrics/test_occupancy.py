"""Map quality against exact worlds, static ones and ones with moving boxes."""

import json

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.evaluators.metrics.occupancy import assess_by_distance, check_metrics
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.octree.moving_objects import remove_moving_objects
from mapper.octree.ray_casting import Caster
from mapper.octree.scan_updates import pack
from mapper.simulation import Boxes, CameraSimulator, read_scene, write_tum_log
from mapper.simulation.config import SynthConfig
from tests.support.ideal_sensors import IDEAL_SENSOR

PLAIN = SynthConfig(
    furniture_per_room=3,
    posters_per_room=0,
    texture_px_per_m=16,
    width_px=160,
    height_px=120,
    frame_rate_hz=10.0,
    duration_s=6.0,
)
BUSY = PLAIN.model_copy(update={"moving_boxes": 8})
WALL = Boxes(("wall",), np.array([[2.125, 0.0, 0.0]]), np.array([[0.1, 2.0, 2.0]]), np.zeros(1))


def values_of(octree, signed_distance_m, **options):
    metrics = check_metrics(assess_by_distance(octree, signed_distance_m, **options))
    return {metric.name.split(",")[0]: metric.value for metric in metrics}


def ghosts(octree, signed_distance_m):
    """How many voxels are occupied further than a voxel and a half from every solid."""
    return int((signed_distance_m(octree.occupied()) > 1.5 * octree.resolution_m).sum())


def wall_seen(at_x_m):
    """A map of a wall's face that was measured at a distance along x."""
    y, z = (axis.ravel() for axis in np.meshgrid(*[np.arange(-1.0, 1.0, 0.05) + 0.025] * 2))
    octree = OctreeMap(OctreeConfig())
    octree.insert_points(np.column_stack([np.full(len(y), at_x_m), y, z]).astype(np.float32), np.zeros(3))
    return octree


def updates_of(source):
    caster = Caster(OctreeConfig())
    poses = source.truth.T_world_body
    return [pack(caster.cast(entry.scan(), poses[i])) for i, entry in enumerate(source.log().entries())]


def merged(updates):
    octree = OctreeMap(OctreeConfig())
    for update in updates:
        octree.merge(update)
    return octree


@pytest.fixture(scope="module")
def busy():
    source = CameraSimulator(BUSY)
    return source, updates_of(source)


def test_a_wall_where_it_is_scores_one_and_a_wall_where_it_is_not_is_noticed():
    right, near = wall_seen(2.03), wall_seen(1.97)
    assert values_of(right, WALL.signed_distance_m) == {
        "occupied precision": 1.0,
        "occupied recall where the map looked": 1.0,
        "occupied F-score": 1.0,
        "free precision": 1.0,
        "free recall": 1.0,
    }
    assert ghosts(near, WALL.signed_distance_m) == 0
    assert ghosts(right, WALL.signed_distance_m) == 0
    assert ghosts(wall_seen(1.7), WALL.signed_distance_m) == 40 * 40


def test_voxels_freed_inside_a_wall_count_against_free_precision():
    through = values_of(wall_seen(2.4), WALL.signed_distance_m)
    assert through["free precision"] < 0.99
    assert through["occupied recall where the map looked"] < 0.1


def test_an_empty_map_cannot_be_judged():
    with pytest.raises(DataError, match="no known surface"):
        assess_by_distance(OctreeMap(OctreeConfig()), WALL.signed_distance_m)


def test_a_noisy_log_with_true_poses_maps_the_world_to_a_voxel():
    source = CameraSimulator(PLAIN)
    values = values_of(merged(updates_of(source)), source.scene.boxes.signed_distance_m)
    assert min(values.values()) >= 0.97, values


def test_what_moves_is_seen_where_it_is_and_leaves_the_truth_alone(busy):
    source, _ = busy
    times_s = np.arange(0.0, 60.0, 0.1)
    centers = np.array([source.movers.boxes_at(t).centers_world for t in times_s])

    speeds = np.linalg.norm(np.diff(centers, axis=0), axis=2) / 0.1
    assert ((speeds > 0.25) & (speeds < 0.75)).all()
    flat = source.scene.boxes.signed_distance_m(centers.reshape(-1, 3))
    assert flat.min() > 0.2, "they keep to the way that furniture leaves free"
    tops = source.movers.still.centers_world[:, 2] + source.movers.still.half_sizes_m[:, 2]
    assert tops.max() < 0.8 < source.truth.positions_world[:, 2].min()
    assert source.scene.boxes.as_json() == CameraSimulator(PLAIN).scene.boxes.as_json()

    exact = CameraSimulator(BUSY.model_copy(update={"sensor": IDEAL_SENSOR}))
    moving = exact.render(30).surface >= 6 * len(exact.scene.boxes)
    assert moving.any()
    still = CameraSimulator(PLAIN.model_copy(update={"sensor": IDEAL_SENSOR})).render(30)
    np.testing.assert_array_equal(exact.render(30).depth_m[~moving], still.depth_m[~moving])


def test_removal_of_moving_objects_leaves_fewer_ghosts_and_spares_the_walls(busy):
    source, updates = busy
    truth = source.scene.boxes.signed_distance_m
    plain, removed = merged(updates), merged(updates)
    remove_moving_objects(removed, lambda: updates)

    assert ghosts(plain, truth) > 200
    assert ghosts(removed, truth) < 0.6 * ghosts(plain, truth)
    before, after = values_of(plain, truth), values_of(removed, truth)
    recall = "occupied recall where the map looked"
    assert after[recall] >= before[recall]
    assert after["occupied precision"] > before["occupied precision"]


def test_the_scene_file_has_the_poses_of_the_boxes(tmp_path):
    config = BUSY.model_copy(update={"duration_s": 0.2, "moving_boxes": 2})
    write_tum_log(tmp_path / "busy", config)
    write_tum_log(tmp_path / "still", config.model_copy(update={"moving_boxes": 0}))
    scene, still = (json.loads((tmp_path / name / "scene.json").read_text()) for name in ("busy", "still"))

    source = CameraSimulator(config)
    assert [len(row["centers_m"]) for row in scene["moving"]] == [3, 3]
    np.testing.assert_array_equal(
        [row["centers_m"][2] for row in scene["moving"]], source.movers.boxes_at(0.2).centers_world
    )
    assert SynthConfig(**scene["config"]) == config
    assert "moving" not in still
    assert "moving_boxes" not in still["config"]
    assert read_scene(tmp_path / "busy/scene.json").as_json() == source.scene.boxes.as_json()
