"""Poses of a run with their covariance: ``poses.csv``."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import GraphError
from mapper.core.geometry import Array, adjoint, inverse
from mapper.core.rotations import pose_of_row, row_of_pose
from mapper.core.trajectory import Trajectory
from mapper.graph.marginals import marginals_of
from mapper.graph.model import PoseGraph
from mapper.run.doubtful_frames import estimates_of_doubtful
from mapper.run.frame_records import FrameRecord
from mapper.runtime.csv_file import read_csv, write_csv

_AXES = ("roll", "pitch", "yaw", "x", "y", "z")
_UPPER = np.triu_indices(6)
_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_COVARIANCE = tuple(f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True))
_COLUMNS = ("stamp_ns", "outcome", *_POSE, *_COVARIANCE)


@dataclass(frozen=True, slots=True, eq=False)
class UncertainPoses:
    """Poses of the body with their covariance.

    Attributes:
        trajectory: Poses in the levelled world, of tracked and doubtful frames.
        is_doubtful: (N,) which of them may be wrong.
        covariances: (N, 6, 6) in the body's tangent (rotation, translation), rad² and m², the first node
            being fixed; NaN where nothing is known.
    """

    trajectory: Trajectory
    is_doubtful: NDArray[np.bool_]
    covariances: Array

    def __len__(self) -> int:
        return len(self.trajectory)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Yield a row of ``poses.csv`` for each pose, by column, of which pandas makes a table."""
        for (stamp_ns, T), is_doubtful, covariance in zip(
            self.trajectory.items(), self.is_doubtful.tolist(), self.covariances, strict=True
        ):
            outcome = "doubtful" if is_doubtful else "tracked"
            row = (stamp_ns, outcome, *row_of_pose(T).tolist(), *covariance[_UPPER].tolist())
            yield dict(zip(_COLUMNS, row, strict=True))

    def __repr__(self) -> str:
        return f"UncertainPoses of {len(self)} poses, {np.count_nonzero(self.is_doubtful)} doubtful"

    @property
    def position_covariances_world(self) -> Array:
        """(N, 3, 3) of the positions along the world's axes, m²; NaN where nothing is known."""
        R_world_body = self.trajectory.T_world_body[:, :3, :3]
        return R_world_body @ self.covariances[:, 3:, 3:] @ R_world_body.transpose(0, 2, 1)

    @property
    def position_sigmas_m(self) -> Array:
        """(N,) standard deviation of the position in its least certain direction; NaN if unknown."""
        return _largest_sigmas(self.covariances[:, 3:, 3:])

    @property
    def end_sigma_m(self) -> float:
        """Standard deviation of the last position that is known and not doubtful; NaN without any."""
        sigmas_m = self.position_sigmas_m
        known = np.flatnonzero(np.isfinite(sigmas_m) & ~self.is_doubtful)
        return float(sigmas_m[known[-1]]) if len(known) > 1 else np.nan

    @property
    def horizontal_sigmas_m(self) -> Array:
        """(N,) the same of the position seen from above."""
        return _largest_sigmas(self.position_covariances_world[:, :2, :2])


def _largest_sigmas(covariances: Array) -> Array:
    sigmas = np.full(len(covariances), np.nan)
    known = np.isfinite(covariances).all(axis=(1, 2))
    if known.any():
        sigmas[known] = np.sqrt(np.linalg.eigvalsh(covariances[known])[:, -1].clip(0.0))
    return sigmas


def uncertain_poses(
    trajectory: Trajectory, graph: PoseGraph, records: Sequence[FrameRecord]
) -> UncertainPoses:
    """Return the poses with the covariance of their node and, relative to it, their own.

    Σ_frame = Ad(T_body_node) · Σ_node · Ad(T_body_node)ᵀ + Σ_own: to first order, the two being independent.
    Σ_own is diagonal, as ``frames.csv`` has it; a frame without one has that of its node, and one
    that is the node has no other. A graph that leaves a node undetermined gives none.

    Args:
        trajectory: Poses of all frames that were placed, in the world of the graph.
        graph: Nodes at their solution, with the factors that hold.
        records: Outcome of every frame.
    """
    try:
        of_nodes = marginals_of(graph).nodes
    except GraphError:
        of_nodes = {}
    record_of = {record.stamp_ns: record for record in records}
    doubtful = estimates_of_doubtful(trajectory, graph, records)
    covariances = np.full((len(trajectory), 6, 6), np.nan)
    is_doubtful = np.zeros(len(trajectory), np.bool_)
    for index, (stamp_ns, T_world_body) in enumerate(trajectory.items()):
        record = record_of.get(stamp_ns)
        if record is None:
            continue
        is_doubtful[index] = record.outcome == "doubtful"
        if record.node not in of_nodes:
            continue
        covariances[index] = of_nodes[record.node]
        if not record.is_keyframe:
            to_body = adjoint(inverse(T_world_body) @ graph.T_world_node[record.node])
            covariances[index] = to_body @ covariances[index] @ to_body.T
            own = doubtful[stamp_ns].variances if stamp_ns in doubtful else None
            if own is None and record.sigmas is not None:
                own = np.square(record.sigmas)
            if own is not None:
                covariances[index] += np.diag(own)
    return UncertainPoses(trajectory, is_doubtful, 0.5 * (covariances + covariances.transpose(0, 2, 1)))


def write_poses(path: Path, poses: UncertainPoses) -> None:
    """Write CSV with a header: poses with every digit, the covariance's upper triangle row by row."""
    write_csv(path, _COLUMNS, _rows(poses))


def read_poses(path: Path) -> UncertainPoses:
    """Return what ``write_poses`` wrote.

    Raises:
        RunError: The file cannot be read.
        DataError: It is something else.
    """
    return read_csv(path, _COLUMNS, _poses_of, of="poses")


def _rows(poses: UncertainPoses) -> Iterator[list[object]]:
    for row in poses:
        stamp_ns, outcome, *numbers = row.values()
        pose, covariance = numbers[: len(_POSE)], numbers[len(_POSE) :]
        yield [
            stamp_ns,
            outcome,
            *map(repr, pose),
            *(f"{value:.9g}" if np.isfinite(value) else "" for value in covariance),
        ]


def _poses_of(table: Iterable[Mapping[str, str]]) -> UncertainPoses:
    rows = list(table)
    poses = np.array([[float(row[name]) for name in _POSE] for row in rows]).reshape(-1, 7)
    stamps_ns = np.array([int(row["stamp_ns"]) for row in rows], np.int64)
    trajectory = Trajectory(stamps_ns, pose_of_row(poses))
    covariances = np.empty((len(rows), 6, 6))
    for row, covariance in zip(rows, covariances, strict=True):
        covariance[_UPPER] = [np.nan if row[name] == "" else float(row[name]) for name in _COVARIANCE]
        covariance.T[_UPPER] = covariance[_UPPER]
    is_doubtful = np.array([row["outcome"] == "doubtful" for row in rows], np.bool_)
    return UncertainPoses(trajectory, is_doubtful, covariances)
