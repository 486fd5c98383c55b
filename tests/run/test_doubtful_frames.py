"""Doubtful frames placed by the tracked frames around them."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.core.geometry import exp, inverse, log
from mapper.core.trajectory import Trajectory
from mapper.graph.model import PoseGraph
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.run.doubtful_frames import placed_by_neighbours, without_doubtful
from mapper.run.frame_records import read_records, records_of, write_records
from mapper.run.stored_tracking import StoredTracking

STEP_NS = 50_000_000
DIAGNOSTICS = Diagnostics(100, 50, 40, 0.01, "m", "map")
WRONG = exp(np.array([0.0, 0.2, 0.0]), np.array([0.6, 0.0, 0.0]))


def path_of(count):
    """A walk along a curve whose speed changes, so that no constant velocity is exact."""
    times = np.arange(count) * STEP_NS / 1e9
    return [
        exp(np.array([0.0, 0.0, 0.3 * np.sin(t)]), np.array([0.4 * t, 0.1 * np.sin(2.0 * t), 0.02 * t]))
        for t in times
    ]


def tracks_of(count, doubted, *, sigma=0.5, period=10, repeats=False):
    """Frames of a walk, a keyframe in every period; the doubted ones are 0.6 m off."""
    poses = path_of(count)
    tracks = []
    for k, T in enumerate(poses):
        node = k // period
        is_doubted = k in doubted
        T_node_body = inverse(poses[node * period]) @ T
        tracks.append(
            FrameResult(
                k * STEP_NS,
                node,
                T_node_body @ WRONG if is_doubted else T_node_body,
                T,
                k % period == 0,
                DIAGNOSTICS,
                doubts=(Doubt("repeated image" if repeats else "jump", "0.6 m"),) if is_doubted else (),
                covariance=None if sigma is None else np.eye(6) * (sigma if is_doubted else 1e-3) ** 2,
            )
        )
    nodes = {node: poses[node * period] for node in range((count + period - 1) // period)}
    graph = PoseGraph(nodes, {node: node * period * STEP_NS for node in nodes}, [])
    return tracks, graph, poses


def placed(tracks, graph):
    records = records_of(tracks, [])
    own = Trajectory(
        np.array([track.stamp_ns for track in tracks]),
        np.array([graph.T_world_node[track.node] @ track.T_node_body for track in tracks]),
    )
    return placed_by_neighbours(own, graph, records), own, records


def miss_m(trajectory, poses, k):
    return float(np.linalg.norm(trajectory.positions_world[k] - poses[k][:3, 3]))


def test_a_wrong_frame_is_placed_where_its_neighbours_lead():
    tracks, graph, poses = tracks_of(100, {34, 35, 36})
    trajectory, own, records = placed(tracks, graph)
    for k in (34, 35, 36):
        assert miss_m(own, poses, k) > 0.5
        assert miss_m(trajectory, poses, k) < 0.02
    others = [k for k in range(100) if k not in (34, 35, 36)]
    np.testing.assert_array_equal(trajectory.T_world_body[others], own.T_world_body[others])
    assert len(without_doubtful(trajectory, records)) == 97


def test_through_a_long_gap_frames_of_one_image_follow_the_velocities_at_its_ends():
    tracks, graph, poses = tracks_of(400, set(range(190, 235)), sigma=10.0, period=400, repeats=True)
    trajectory, _, _ = placed(tracks, graph)
    off_line_m = np.linalg.norm(0.5 * (poses[189] + poses[235])[:3, 3] - poses[212][:3, 3])
    assert max(miss_m(trajectory, poses, k) for k in range(190, 235)) < 0.5 * off_line_m


def test_what_is_known_better_weighs_more():
    misses = []
    for sigma in (1e-6, 3e-4, 1.0):
        tracks, graph, poses = tracks_of(100, {35}, sigma=sigma)
        misses.append(miss_m(placed(tracks, graph)[0], poses, 35))
    assert misses[0] > 0.55
    assert misses[0] > misses[1] > misses[2]
    assert misses[2] < 0.01


def test_an_unknown_covariance_leaves_it_to_the_neighbours():
    tracks, graph, poses = tracks_of(100, {35}, sigma=None)
    assert miss_m(placed(tracks, graph)[0], poses, 35) < 0.01


@pytest.mark.parametrize("doubted", [{0, 1}, {98, 99}, set(range(30, 75))], ids=["first", "last", "over 2 s"])
def test_without_neighbours_within_two_seconds_a_frame_keeps_its_pose(doubted):
    tracks, graph, _ = tracks_of(100, doubted, period=200)
    trajectory, own, _ = placed(tracks, graph)
    np.testing.assert_allclose(trajectory.T_world_body, own.T_world_body, atol=1e-9)


def test_a_doubtful_node_stays_where_the_graph_put_it():
    tracks, graph, _ = tracks_of(100, {30})
    trajectory, own, records = placed(tracks, graph)
    assert records[30].outcome == "doubtful"
    assert records[30].pose_in_node is None
    np.testing.assert_array_equal(trajectory.T_world_body, own.T_world_body)


def test_another_solution_places_it_anew_by_what_was_tracked(tmp_path):
    tracks, graph, poses = tracks_of(100, {37, 38})
    trajectory, _, records = placed(tracks, graph)
    write_records(tmp_path / "frames.csv", records)
    read = read_records(tmp_path / "frames.csv")
    assert read == records
    stored = StoredTracking(read, [], {}, trajectory, graph, [], None)

    # All that follows the doubt moves away: a loop corrects the step that was wrong.
    T_far = exp(np.zeros(3), np.array([0.0, 1.0, 0.0]))
    moved = {node: T if node <= 3 else T_far @ T for node, T in graph.T_world_node.items()}
    solved = stored.solved(PoseGraph(moved, graph.stamps_ns, []), [])
    again = solved.solved(graph, [])

    np.testing.assert_allclose(again.trajectory.T_world_body, trajectory.T_world_body, atol=1e-9)
    before, after = (solved.trajectory.positions_world[k] for k in (39, 40))
    assert np.linalg.norm(after - before) > 0.9  # both tracked: they moved with their nodes
    rotation_rad, translation_m = log(inverse(poses[37]) @ solved.trajectory.T_world_body[37])
    assert np.linalg.norm(translation_m) < 0.02
    assert np.linalg.norm(rotation_rad) < 0.02


def test_lost_frames_have_no_pose_of_their_own():
    tracks, _, _ = tracks_of(20, {5})
    lost = replace(tracks[5], node=None)
    (record,) = records_of([lost], [])
    assert record.outcome == "lost"
    assert record.pose_in_node is None
