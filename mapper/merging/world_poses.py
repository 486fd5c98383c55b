"""Runs in the map, with the poses of their worlds: as they are, by their truths, or from a file."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError, RunError
from mapper.core.geometry import Array, Transform, fit_rigid, inverse
from mapper.core.rotations import pose_of_row
from mapper.core.timebase import MAX_TRUTH_GAP_NS, nearest
from mapper.core.trajectory import Trajectory
from mapper.mapping.config import edits_of
from mapper.merging.multi_session_graph import JointGraph
from mapper.octree.config import OctreeConfig
from mapper.octree.scan_updates import displacement_m, longest_ray_m
from mapper.run import files
from mapper.run.doubtful_frames import without_doubtful
from mapper.run.edits_file import edits_text, parse_edits
from mapper.run.folder import Run
from mapper.runtime.regular_files import read_text


@dataclass(frozen=True, slots=True, eq=False)
class InMap:
    """A run as it lies in a merged map that exists already.

    Attributes:
        folder: Folder of its files in that map.
        trajectory_map: As of ``Placed``: its voxels lie within half a voxel of it.
        moved_m: As of ``Placed``, when it was merged.
        fused_again: Whether it was fused again then.
    """

    folder: Path
    trajectory_map: Trajectory
    moved_m: float
    fused_again: bool


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A run in the map.

    Attributes:
        run: The run.
        T_map_world: (4, 4) pose of its world in the map.
        how: Source of the pose, in a few words.
        bent: Its frames' poses in its own world by a joint graph; None keeps those of the run.
        kept: Its pose in the map that runs are added to, where that still holds.
    """

    run: Run
    T_map_world: Transform
    how: str
    bent: Trajectory | None = None
    kept: InMap | None = None

    @property
    def stays(self) -> bool:
        """Whether its voxels are the map's, so that nothing has to be resampled."""
        return np.array_equal(self.T_map_world, np.eye(4))

    @property
    def trajectory_map(self) -> Trajectory:
        """Poses in the map of the frames that its maps are made from."""
        if self.kept is not None:
            return self.kept.trajectory_map
        return without_doubtful(self.bent or self.run.trajectory, self.run.records).moved(self.T_map_world)

    @property
    def moved_m(self) -> float:
        """Bound on how far any point of its own map has moved in its world, metres."""
        if self.kept is not None:
            return self.kept.moved_m
        if self.bent is None:
            return 0.0
        after = without_doubtful(self.bent, self.run.records)
        return farthest_m(self.run.tracked_trajectory, after, self.run.fused_config.octree)


def farthest_m(before: Trajectory, after: Trajectory, config: OctreeConfig) -> float:
    """Return a bound on how far any point that frames saw has moved, metres, with their poses."""
    range_m = longest_ray_m(config)
    pairs = zip(before.T_world_body, after.T_world_body, strict=True)
    return max((displacement_m(*pair, range_m=range_m) for pair in pairs), default=0.0)


@dataclass(frozen=True, slots=True)
class Placing:
    """Runs in the map, and those whose pose is not known.

    Attributes:
        placed: Runs in the order in which they were given.
        left_out: Why each of the others is not in the map, by the run's path.
        warnings: What may be wrong with the poses, a line each.
        joint: The pose graph of all of them; None if they are placed as rigid bodies.
    """

    placed: Sequence[Placed]
    left_out: Mapping[str, str] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    joint: JointGraph | None = None

    @property
    def notes(self) -> list[str]:
        """Notes for the user, a line each."""
        return [*(f"{path}: left out, {reason}" for path, reason in self.left_out.items()), *self.warnings]


def as_built(runs: Sequence[Run]) -> list[Placed]:
    """Place every run by the identity: sessions of one chain, or logs that were mapped in one frame."""
    return [Placed(run, np.eye(4), "as built") for run in runs]


def by_truth(runs: Sequence[Run]) -> list[Placed]:
    """Place runs by their truths, which share a frame, in the world of the first.

    The first run is not moved, so the map is as level as it is, and as sharp.

    Raises:
        RunError: A run has no truth, or fewer than three poses with one.
    """
    T_truth_worlds, misses_m = zip(*(_fit_to_truth(run) for run in runs), strict=True)
    T_map_truth = inverse(T_truth_worlds[0])
    T_map_worlds = [np.eye(4), *(T_map_truth @ T_truth_world for T_truth_world in T_truth_worlds[1:])]
    return [
        Placed(run, T_map_world, f"by truth, RMS {miss_m:.2g} m")
        for run, T_map_world, miss_m in zip(runs, T_map_worlds, misses_m, strict=True)
    ]


def by_poses(runs: Sequence[Run], path: Path) -> list[Placed]:
    """Place runs by a file: a line ``RUN tx ty tz qx qy qz qw``, the pose of its world, for each folder.

    Raises:
        DataError: The file cannot be read, a line is not like that, or a run has none or two.
        RunError: Two runs have the same name.
    """
    poses = _read_poses(path)
    names = Counter(_name(run) for run in runs)
    for name, count in names.items():
        if count > 1:
            raise RunError(f"{name}: {count} runs have this name, and {path} names runs by it; rename one")
        if name not in poses:
            raise DataError(f"{path}: has no line for {name}; want {name} tx ty tz qx qy qz qw")
    return [Placed(run, poses[_name(run)], f"by {path.name}") for run in runs]


def warnings_about(placed: Sequence[Placed]) -> list[str]:
    """Return warnings about the runs that are going to be added up, a line each."""
    found = []
    if len(placed) > 1 and all(item.stays for item in placed):
        found.append(
            "every run's world was taken for the map's; for runs mapped apart see --place and --poses"
        )
    for item in placed:
        verdict = item.run.manifest.verdict
        if verdict is not None and verdict.state != "trusted":
            found.append(f"{_name(item.run)} is {verdict.state}: {verdict.sentences[0]}")
        if parse_edits(edits_text(item.run.path), item.run.path) != edits_of(item.run.manifest.edits):
            found.append(
                f"{_name(item.run)}: its maps were made before {files.EDITS} was changed and are merged "
                f"as they are; mapper fuse {item.run.path}, then merge again"
            )
    used = [_frames_used(item.run) for item in placed]
    for second, item in enumerate(placed):
        for first, other in enumerate(placed[:second]):
            shared = sum(len(stamps & used[first].get(log, set())) for log, stamps in used[second].items())
            if shared:
                found.append(
                    f"{_name(other.run)} and {_name(item.run)} were made from {shared} frames that are the "
                    "same; these count twice"
                )
    return found


def _name(run: Run) -> str:
    return run.path.resolve().name  # the path may be a dot


def _frames_used(run: Run) -> dict[str, set[int]]:
    """Return the stamps of the frames that a run has used of each log, by the log's fingerprint."""
    stamps_ns = run.trajectory.stamps_ns
    logs = (run.manifest.input, *run.manifest.input.appended)
    begins = np.searchsorted(stamps_ns, [log.begins_ns for log in run.manifest.input.appended])
    sessions = np.split(stamps_ns, begins)
    shifts_ns = (0, *(log.shift_ns for log in run.manifest.input.appended))
    return {
        log.fingerprint: set((session - shift_ns).tolist())
        for log, session, shift_ns in zip(logs, sessions, shifts_ns, strict=True)
    }


def _fit_to_truth(run: Run) -> tuple[Transform, float]:
    """Return T_truth_world, and the RMS distance in metres that it leaves."""
    truth, trajectory = run.truth, run.trajectory
    if truth is None:
        raise RunError(f"{run.path}: has no truth to be placed by; give its pose with --poses")
    index, gap_ns = nearest(truth.stamps_ns, trajectory.stamps_ns)
    near = gap_ns <= MAX_TRUTH_GAP_NS
    if np.count_nonzero(near) < 3:
        raise RunError(
            f"{run.path}: {np.count_nonzero(near)} poses have a truth within 20 ms, want 3; use --poses"
        )
    T_truth_body, T_world_body = truth.T_world_body[index[near]], trajectory.T_world_body[near]
    T_truth_world = fit_poses(T_truth_body, T_world_body)
    misses = (T_truth_world @ T_world_body)[:, :3, 3] - T_truth_body[:, :3, 3]
    return T_truth_world, float(np.sqrt((misses**2).sum(axis=1).mean()))


def fit_poses(T_a_body: Array, T_b_body: Array) -> Transform:
    """Return the T_a_b by which (N, 4, 4) poses in a fit those in b best, axes of a metre included."""
    T_a_b, _ = fit_rigid(_with_axes(T_a_body), _with_axes(T_b_body))
    return T_a_b


def _with_axes(T_a_body: Array) -> Array:
    """Return (4 N, 3) positions, followed by the ends of the body's axes, a metre long.

    A straight path alone leaves a turn about itself open.
    """
    ends = T_a_body[:, :3, 3, np.newaxis] + T_a_body[:, :3, :3]
    return np.concatenate([T_a_body[:, :3, 3], ends.transpose(0, 2, 1).reshape(-1, 3)])


def _read_poses(path: Path) -> dict[str, Transform]:
    poses: dict[str, Transform] = {}
    for number, line in enumerate(read_text(path, may_be_pipe=True).splitlines(), start=1):
        name, *words = line.replace(",", " ").split() or [""]
        if not name or name.startswith("#"):
            continue
        try:
            values = np.array([float(word) for word in words])
            if values.shape != (7,) or not np.isfinite(values).all():
                raise ValueError
            pose = pose_of_row(values)
        except (ValueError, DataError):
            raise DataError(f"{path}:{number}: want RUN tx ty tz qx qy qz qw, all but RUN numbers") from None
        if name in poses:
            raise DataError(f"{path}:{number}: a second pose of {name}; remove one")
        poses[name] = pose
    return poses
