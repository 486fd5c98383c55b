"""Results of a run, read together for its MCAP log, a viewer or a report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.geometry import fit_rigid
from mapper.core.timebase import MAX_TRUTH_GAP_NS, nearest
from mapper.core.trajectory import Trajectory
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure
from mapper.run.doubtful_frames import without_doubtful
from mapper.run.frame_records import FrameRecord
from mapper.run.pose_covariances import UncertainPoses


@dataclass(frozen=True, slots=True, eq=False)
class RunResults:
    """A tracked log.

    Attributes:
        trajectory: Final body poses in the levelled world, of doubtful frames too; at least one.
        graph: Nodes at the solution, same world.
        records: Outcome of every frame.
        loops: Every loop candidate with its verdict.
        frame_ms: Milliseconds that each frame took, by stamp; empty leaves them out.
        truth: True body poses, aligned with the trajectory, if known.
        poses: The trajectory with its covariances.
    """

    trajectory: Trajectory
    graph: PoseGraph
    records: Sequence[FrameRecord]
    loops: Sequence[LoopClosure]
    frame_ms: Mapping[int, float]
    truth: Trajectory | None
    poses: UncertainPoses

    def __repr__(self) -> str:
        counts = (
            f"{len(self.trajectory)} poses, {len(self.graph.T_world_node)} nodes, {len(self.loops)} loops"
        )
        return f"RunResults of {counts}"

    @property
    def tracked(self) -> Trajectory:
        """The poses of the frames that maps are made from: those that are not doubtful."""
        return without_doubtful(self.trajectory, self.records)


def aligned_truth(truth: Trajectory, trajectory: Trajectory) -> Trajectory | None:
    """Return the truth of the trajectory's time, moved to where it fits best.

    None if they share no three stamps.
    """
    pairs = with_truth(truth, trajectory)
    if pairs is None:
        return None
    estimated, known = pairs
    T_level_truth, _ = fit_rigid(estimated.positions_world, known.positions_world)
    first_ns, last_ns = trajectory.stamps_ns[[0, -1]]
    meanwhile = slice(
        *np.searchsorted(truth.stamps_ns, [first_ns - MAX_TRUTH_GAP_NS, last_ns + MAX_TRUTH_GAP_NS])
    )
    return truth[meanwhile].moved(T_level_truth)


def with_truth(truth: Trajectory, trajectory: Trajectory) -> tuple[Trajectory, Trajectory] | None:
    """Return the poses whose truth is known, and the true ones at their stamps; None if fewer than 3 are."""
    index, gap_ns = nearest(truth.stamps_ns, trajectory.stamps_ns)
    near = gap_ns <= MAX_TRUTH_GAP_NS
    if near.sum() < 3:
        return None
    stamps_ns, T_world_body = trajectory.stamps_ns[near], truth.T_world_body[index[near]]
    return trajectory[near], replace(truth, stamps_ns=stamps_ns, T_world_body=T_world_body)
