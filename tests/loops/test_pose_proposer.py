"""The pose proposer finds what is nearby by the poses as they are estimated now, among however many."""

from types import SimpleNamespace

import numpy as np
import pytest

from mapper.core.geometry import transform
from mapper.loops.nearby_proposer import PoseProposer

SEEN = SimpleNamespace(stamp_ns=0)


class Poses:
    """Poses of nodes on a line, 0.1 m apart, which can be corrected."""

    def __init__(self, count):
        self.corrections = 0
        self.T_world_node = {k: transform(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(count)}

    def pose_of(self, node):
        return self.T_world_node[node]

    def move(self, node, x_m):
        self.T_world_node = {**self.T_world_node, node: transform(np.eye(3), np.array([x_m, 0.0, 0.0]))}
        self.corrections += 1


def proposer_of(poses, nodes, *, drift_ratio=0.0):
    proposer = PoseProposer(
        poses, lambda _: np.eye(4), max_distance_m=0.25, max_angle_rad=0.1, drift_ratio=drift_ratio
    )
    for node in nodes:
        proposer.add(node, SEEN)
    return proposer


@pytest.mark.parametrize("count", [3, 256, 700])
def test_the_nearest_of_the_first_places_come_first(count):
    poses = Poses(count)
    proposer = proposer_of(poses, range(count))
    found = proposer.propose(count - 1, SEEN, before=count - 1, limit=5)
    assert [proposal.node for proposal in found] == [count - 2, count - 3]
    for before in (0, 1):
        far = proposer.propose(count - 1, SEEN, before=before, limit=5)
        assert [proposal.node for proposal in far] == ([0] if before and count == 3 else [])


def test_places_are_where_a_loop_has_moved_them():
    poses = Poses(300)
    proposer = proposer_of(poses, range(300))
    assert proposer.propose(299, SEEN, before=100, limit=5) == []
    poses.move(7, 29.8)
    assert [proposal.node for proposal in proposer.propose(299, SEEN, before=100, limit=5)] == [7]
    assert proposer.within_reach(299, SEEN, before=100).nonzero()[0].tolist() == [7]


def test_the_reach_grows_with_the_path_since():
    proposer = proposer_of(Poses(11), range(11), drift_ratio=0.5)
    # Node k is 0.1 · (10 − k) m away along the path, too, half of which is added to 0.25 m.
    within = proposer.within_reach(10, SEEN, before=10)
    assert within.tolist() == [0.1 * (10 - k) <= 0.25 + 0.05 * (10 - k) for k in range(10)]
