"""poses.csv: poses with their covariance, written and read back."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.core.errors import DataError, RunError
from mapper.core.geometry import adjoint, exp, inverse
from mapper.core.trajectory import trajectory_from
from mapper.graph.marginals import marginals_of
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.odometry.base import Diagnostics
from mapper.run.frame_records import FrameRecord
from mapper.run.pose_covariances import read_poses, uncertain_poses, write_poses

DIAGNOSTICS = Diagnostics(100, 50, 40, 0.01, "m", "map")
OWN = (0.01, 0.02, 0.03, 0.1, 0.2, 0.3)
T_NODE_BODY = exp(np.array([0.1, 0.0, 0.4]), np.array([0.5, 0.2, 0.0]))


def run_of(count=6, own=OWN):
    """A keyframe and a frame that hangs on it, and so on."""
    graph, poses, records = PoseGraph(), [], []
    T = exp(np.array([0.0, 0.0, 0.3]), np.zeros(3))
    step = exp(np.array([0.0, 0.02, 0.2]), np.array([1.0, 0.0, 0.0]))
    for node in range(count):
        graph.add_node(node, 2 * node, T)
        if node:
            graph.add_factors([BetweenFactor(node - 1, node, step, PoseSigmas(0.01, 0.02).information)])
        poses += [(2 * node, T), (2 * node + 1, T @ T_NODE_BODY)]
        records += [
            FrameRecord(2 * node, "tracked", node, True, DIAGNOSTICS, sigmas=own),
            FrameRecord(2 * node + 1, "tracked", node, False, DIAGNOSTICS, sigmas=own),
        ]
        T = T @ step
    return trajectory_from(poses), graph, records


def test_a_frame_adds_its_own_covariance_to_that_of_its_node():
    trajectory, graph, records = run_of()
    poses = uncertain_poses(trajectory, graph, records)
    of_nodes = marginals_of(graph).nodes
    to_body = adjoint(inverse(T_NODE_BODY))
    for node, covariance in of_nodes.items():
        np.testing.assert_allclose(poses.covariances[2 * node], covariance, atol=1e-15)
        expected = to_body @ covariance @ to_body.T + np.diag(np.square(OWN))
        np.testing.assert_allclose(poses.covariances[2 * node + 1], expected, atol=1e-12)
    assert (np.diff(poses.position_sigmas_m[::2]) > 0.0).all()
    np.testing.assert_allclose(poses.position_sigmas_m[:2], [0.0, 0.3], atol=1e-12)


def test_what_a_lever_arm_does_to_an_angle():
    trajectory, graph, records = run_of(own=None)
    poses = uncertain_poses(trajectory, graph, records)
    errors = []
    rng = np.random.default_rng(0)
    spread = np.linalg.cholesky(poses.covariances[10] + 1e-18 * np.eye(6))
    for _ in range(4000):
        step = spread @ rng.normal(size=6)
        moved = inverse(T_NODE_BODY) @ exp(step[:3], step[3:]) @ T_NODE_BODY
        errors.append(moved[:3, 3])
    found = np.diag(np.cov(np.array(errors).T))
    np.testing.assert_allclose(found, np.diag(poses.covariances[11])[3:], rtol=0.1)


def test_it_is_read_as_it_was_written(tmp_path):
    trajectory, graph, records = run_of()
    records[3] = replace(records[3], outcome="doubtful", doubts=(Doubt("jump", "jump"),))
    records[5] = replace(records[5], node=None, outcome="lost")  # its pose was given by a user
    poses = uncertain_poses(trajectory, graph, records)
    assert np.isnan(poses.covariances[5]).all()
    assert np.isnan(poses.position_sigmas_m[5])
    write_poses(tmp_path / "poses.csv", poses)
    read = read_poses(tmp_path / "poses.csv")
    np.testing.assert_array_equal(read.trajectory.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(read.trajectory.T_world_body, trajectory.T_world_body, atol=1e-12)
    np.testing.assert_allclose(read.covariances, poses.covariances, rtol=1e-8, atol=1e-15)
    assert np.flatnonzero(read.is_doubtful).tolist() == [3]
    header, *lines = (tmp_path / "poses.csv").read_text().splitlines()
    assert header.startswith("stamp_ns,outcome,x_m,y_m,z_m,qx,qy,qz,qw,cov_roll_roll,cov_roll_pitch")
    assert len(header.split(",")) == 2 + 7 + 21
    assert lines[5].endswith("," * 21)


def test_damage_is_named(tmp_path):
    path = tmp_path / "poses.csv"
    with pytest.raises(RunError, match="cannot be read"):
        read_poses(path)
    trajectory, graph, records = run_of()
    write_poses(path, uncertain_poses(trajectory, graph, records))
    whole = path.read_text()
    path.write_text(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"poses\.csv: not a list of poses"):
        read_poses(path)
