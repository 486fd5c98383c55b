"""Stored tracking: the files of a run that tracking writes and a solve changes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.errors import ConfigError
from mapper.core.geometry import inverse
from mapper.core.trajectory import NO_POSES, Trajectory, carried, trajectory_from
from mapper.graph.g2o import write_g2o
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure, accepted_loops, write_closures
from mapper.run import files
from mapper.run.doubtful_frames import placed_by_neighbours
from mapper.run.folder import Run
from mapper.run.frame_records import FrameRecord, write_frame_ms, write_records
from mapper.run.gnss_file import write_fixes
from mapper.run.manifest import SkippedFrame
from mapper.run.manifest_logs import RobotFrames
from mapper.run.pose_covariances import uncertain_poses, write_poses
from mapper.run.writer import RunWriter
from mapper.sources.base import Skipped
from mapper.sources.trajectory_files import read_tum, write_tum


@dataclass(frozen=True, slots=True, eq=False)
class StoredTracking:
    """A log that has been tracked.

    Attributes:
        records: Outcome of every frame, in time order.
        skipped: The frames that could not be read, and why.
        frame_ms: Wall milliseconds that each frame took, by stamp.
        trajectory: Body poses of the frames that were placed.
        graph: Nodes at their current estimates.
        loops: Every loop candidate with its verdict.
        truth: True body poses, if the log has them.
        T_body_base: Poses of the robot's base in the body, where they move by the log.
    """

    records: Sequence[FrameRecord]
    skipped: Sequence[Skipped]
    frame_ms: Mapping[int, float]
    trajectory: Trajectory
    graph: PoseGraph
    loops: Sequence[LoopClosure]
    truth: Trajectory | None
    T_body_base: Trajectory = NO_POSES

    def solved(self, graph: PoseGraph, loops: Sequence[LoopClosure]) -> "StoredTracking":
        """Return the same frames with the graph at another solution: each moves along with its node.

        Doubtful frames are then placed by their neighbours again.
        """
        node_of = {record.stamp_ns: record.node for record in self.records if record.node is not None}
        before, after = self.graph.T_world_node, graph.T_world_node
        T_after_before = {
            node: after[node] @ inverse(T) for node, T in before.items() if not np.array_equal(after[node], T)
        }
        moved = [
            (
                stamp_ns,
                T_after_before[node] @ T_world_body
                if (node := node_of.get(stamp_ns)) in T_after_before
                else T_world_body,
            )
            for stamp_ns, T_world_body in self.trajectory.items()
        ]
        trajectory = placed_by_neighbours(trajectory_from(moved), graph, self.records)
        return replace(self, trajectory=trajectory, graph=graph, loops=loops)

    def then(self, later: "StoredTracking", *, truth: Trajectory | None) -> "StoredTracking":
        """Return this log followed by a later one whose graph and loops hold those of this one already."""
        return StoredTracking(
            records=[*self.records, *later.records],
            skipped=[*self.skipped, *later.skipped],
            frame_ms={**self.frame_ms, **later.frame_ms},
            trajectory=trajectory_from([*self.trajectory.items(), *later.trajectory.items()]),
            graph=later.graph,
            loops=later.loops,
            truth=truth,
            T_body_base=trajectory_from([*self.T_body_base.items(), *later.T_body_base.items()]),
        )


def base_in_body(run: Run) -> Trajectory:
    """Return T_body_base of a run in whose log they move, at the stamps of ``base.tum``; else no poses."""
    robot = run.manifest.input.robot_of_all or RobotFrames()
    if not robot.base or robot.mounting is not None or not (run.path / files.BASE).is_file():
        return NO_POSES
    T_world_body = dict(read_tum(run.file(files.TRAJECTORY)).items())
    base = read_tum(run.file(files.BASE))
    return trajectory_from((stamp_ns, inverse(T_world_body[stamp_ns]) @ T) for stamp_ns, T in base.items())


def poses_of(run: Run, frame: str) -> Trajectory:
    """Return the poses of a frame on the robot for those of a run's trajectory, where its log tells them.

    Args:
        run: The run.
        frame: "body", "base", or a frame's name in the manifest.

    Raises:
        ConfigError: The log does not say where such a frame is.
    """
    robot = run.manifest.input.robot_of_all or RobotFrames()
    if frame in ("base", robot.base):
        poses = robot.trajectory_of_base(run.trajectory, base_in_body(run))
        if poses:
            return poses
    if frame in ("body", robot.body):
        return run.trajectory
    for sensor in robot.sensors:
        if sensor.name == frame:
            return carried(poses_of(run, sensor.parent), sensor.mounting)
    known = filter(None, (robot.body, robot.base, *(sensor.name for sensor in robot.sensors)))
    raise ConfigError(
        f"{run.path}: frame {frame}: its log does not say where that is; known: {', '.join(['body', *known])}"
    )


def load_tracking(run: Run) -> StoredTracking:
    """Return the stored tracking of a finished run."""
    return StoredTracking(
        records=run.records,
        skipped=[Skipped(frame.stamp_ns, frame.reason) for frame in run.manifest.skipped],
        frame_ms=run.frame_ms,
        trajectory=run.trajectory,
        graph=run.graph,
        loops=run.loops,
        truth=run.truth,
        T_body_base=base_in_body(run),
    )


def save_solved(writer: RunWriter, tracked: StoredTracking) -> None:
    """Write the files of ``save_tracking``, and with which covariance the solution gives every pose."""
    save_tracking(writer, tracked)
    poses = uncertain_poses(tracked.trajectory, tracked.graph, tracked.records)
    write_poses(writer.folder / files.POSES, poses)


def save_tracking(writer: RunWriter, tracked: StoredTracking) -> None:
    """Write the files that keep it, and count what is in them; a graph without nodes is not written."""
    folder, graph = writer.folder, tracked.graph
    save_frames(writer, tracked, nodes=len(graph.T_world_node))
    robot = writer.manifest.input.robot_of_all
    if robot is not None and (base := robot.trajectory_of_base(tracked.trajectory, tracked.T_body_base)):
        write_tum(folder / files.BASE, base)
    if graph.T_world_node:
        write_g2o(folder / files.GRAPH, graph)
        if graph.fixes:
            write_fixes(folder / files.FIXES, graph.fixes)
        keyframes = trajectory_from((graph.stamps_ns[node], T) for node, T in graph.T_world_node.items())
        write_tum(folder / files.KEYFRAMES, keyframes)


def save_frames(writer: RunWriter, tracked: StoredTracking, *, nodes: int) -> None:
    """Write the files about frames and loops, without the graph, and count what is in them.

    Args:
        writer: Writer of the run, or of a localised log.
        tracked: Tracking that is written.
        nodes: Number of the graph's nodes that are of the log.
    """
    folder = writer.folder
    write_records(folder / files.FRAMES, tracked.records)
    write_frame_ms(folder / files.FRAME_MS, tracked.frame_ms)
    write_tum(folder / files.TRAJECTORY, tracked.trajectory)
    write_closures(folder / files.LOOPS, tracked.loops)
    if tracked.truth is not None:
        write_tum(folder / files.TRUTH, tracked.truth)
    outcomes = [record.outcome for record in tracked.records]
    counts = writer.manifest.counts.model_copy(
        update={
            "listed": len(outcomes),
            "read": len(outcomes) - outcomes.count("skipped"),
            **{name: outcomes.count(name) for name in ("skipped", "lost", "doubtful", "tracked")},
            "nodes": nodes,
            "factors": len(tracked.graph.factors),
            "loops": len(accepted_loops(tracked.loops)),
            "loop_candidates": len(tracked.loops),
        }
    )
    writer.update(
        counts=counts,
        skipped=tuple(SkippedFrame(stamp_ns=s.stamp_ns, reason=s.reason) for s in tracked.skipped),
    )
