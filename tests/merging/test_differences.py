import json
import shutil

import cv2
import numpy as np
import pytest

from mapper.core.geometry import apply, exp, inverse
from mapper.merging.differences import compare_maps
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from tests.support.command_line import mapper

ROOM = (np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.5]))
CHAIR = (np.array([1.0, 0.5, 0.0]), np.array([1.5, 1.0, 0.9]))
SHELF = (np.array([-2.9, -1.0, 0.0]), np.array([-2.5, 0.5, 1.8]))
IDENTITY = np.eye(4)
EYES = [np.array([x, y, 1.3]) for x in (-1.5, 0.0, 1.6) for y in (-1.2, 0.2, 1.3)]


def directions(n=25_000):
    """Return evenly spread unit vectors: Fibonacci's spiral on the sphere."""
    k = np.arange(n)
    z = 1.0 - 2.0 * (k + 0.5) / n
    turn = k * np.pi * (3.0 - np.sqrt(5.0))
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


def ends(eye, boxes, rays):
    """Return where rays from inside the room end: on its walls, or on a box in it."""
    with np.errstate(divide="ignore"):
        t = np.maximum((ROOM[0] - eye) / rays, (ROOM[1] - eye) / rays).min(axis=1)
        for low, high in boxes:
            first, last = np.sort([(low - eye) / rays, (high - eye) / rays], axis=0)
            enters, leaves = first.max(axis=1), last.min(axis=1)
            t = np.where((enters < leaves) & (enters > 0.0), np.minimum(t, enters), t)
    return eye + t[:, None] * rays


def room(*boxes, T_world_room=IDENTITY, eyes=EYES):
    octree = OctreeMap(OctreeConfig(resolution_m=0.1, max_range_m=20.0))
    for eye in eyes:
        points = apply(T_world_room, ends(eye, boxes, directions()))
        octree.insert_points(points.astype(np.float32), apply(T_world_room, eye[None])[0])
    return octree


def compared(before, after, T_before_after=IDENTITY):
    return compare_maps(before, after, T_before_after, tolerance_m=0.2, min_voxels=8)


def inside(cluster, box, *, slack_m=0.11):
    low, high = cluster.centres_world.min(axis=0), cluster.centres_world.max(axis=0)
    return (low >= box[0] - slack_m).all() and (high <= box[1] + slack_m).all()


def test_a_chair_that_comes_and_a_shelf_that_goes():
    found = compared(room(SHELF), room(CHAIR))
    assert len(found.appeared) == 1
    assert len(found.vanished) == 1
    assert inside(found.appeared[0], CHAIR)
    assert inside(found.vanished[0], SHELF)
    # What lies within the tolerance of the floor counts as floor.
    np.testing.assert_allclose(found.appeared[0].size_m(0.1), [0.6, 0.6, 0.7], atol=0.21)


def test_a_room_is_the_same_as_itself_seen_in_another_frame():
    T_world_room = exp(np.array([0.0, 0.0, 0.3]), np.array([4.0, -1.0, 0.3]))
    found = compared(room(CHAIR), room(CHAIR, T_world_room=T_world_room), inverse(T_world_room))
    assert not found.appeared
    assert not found.vanished
    assert found.same > 0.99 * (found.same + len(found.not_seen_again))


@pytest.mark.parametrize(("hits", "misses", "differs"), [(2, 4, True), (1, 4, False), (2, 3, False)])
def test_weak_evidence_is_no_change(hits, misses, differs):
    """A wall of 9 voxels: one map hit them so often, the rays of the other passed them so often."""
    wall = np.array([[1.05, y, z] for y in (-0.1, 0.0, 0.1) for z in (-0.1, 0.0, 0.1)], np.float32) + 0.05
    hit, passed = (OctreeMap(OctreeConfig(resolution_m=0.1, max_range_m=20.0)) for _ in range(2))
    for _ in range(hits):
        hit.insert_points(wall, np.array([0.05, 0.05, 0.05]))
    beyond = wall + np.float32([1.0, 0.0, 0.0])
    for _ in range(misses):
        for point in beyond:  # along x, through one voxel of the wall each
            passed.insert_points(point[None], np.array([0.05, point[1], point[2]], np.float64))
    assert bool(compared(passed, hit).appeared) == differs
    assert bool(compared(hit, passed).vanished) == differs


def test_maps_of_two_places_are_doubted():
    found = compared(room(CHAIR), room(SHELF), exp(np.array([0.0, 0.0, 0.8]), np.array([1.5, 1.0, 0.0])))
    assert "--place auto" in found.warning
    assert not compared(room(CHAIR), room(SHELF)).warning


def test_what_was_not_looked_at_again_has_not_vanished():
    eye = np.array([-1.5, 0.2, 1.3])
    away = directions()[directions()[:, 0] < -0.2]
    later = OctreeMap(OctreeConfig(resolution_m=0.1, max_range_m=20.0))
    later.insert_points(ends(eye, [], away).astype(np.float32), eye)
    found = compared(room(CHAIR), later)
    assert not found.vanished
    chair = (found.not_seen_again > CHAIR[0] - 0.1).all(axis=1) & (found.not_seen_again < CHAIR[1] + 0.1).all(
        axis=1
    )
    assert chair.sum() > 50
    assert compared(later, room(CHAIR)).appeared == []
    assert len(compared(later, room(CHAIR)).newly_seen) == len(found.not_seen_again)


def test_the_verb_compares_runs_and_writes_what_it_found(desk_run, tmp_path):
    out = tmp_path / "diff"
    text = mapper("diff", desk_run.path, desk_run.path, "--out", out).output
    assert "0 appeared, 0 vanished" in text
    record = json.loads((out / "manifest.json").read_text())
    assert record["appeared"] == record["vanished"] == []
    assert record["voxels"]["not_seen_again"] == record["voxels"]["newly_seen"] == 0
    np.testing.assert_allclose(record["T_before_after"], np.eye(4), atol=1e-3)
    assert cv2.imread(str(out / "diff.png")) is not None
    assert {path.name for path in out.glob("*.ply")} == {"appeared.ply", "vanished.ply", "not_seen_again.ply"}
    assert "exists already" in mapper("diff", desk_run.path, desk_run.path, "--out", out, status=1).output


def test_runs_are_compared_where_a_file_of_poses_has_them(desk_run, tmp_path):
    again = shutil.copytree(desk_run.path, tmp_path / "again")
    poses = tmp_path / "poses.txt"
    poses.write_text(f"{desk_run.path.name} 0 0 0 0 0 0 1\nagain 0 0 0 0 0 0 1\n")
    text = mapper("diff", desk_run.path, again, "--poses", poses, "--out", tmp_path / "diff").stdout
    assert "placed by poses.txt" in text
    assert "0 appeared, 0 vanished" in text
