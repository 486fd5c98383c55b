"""Trajectories as TUM and KITTI text."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Transform, is_rigid, transform
from mapper.core.rotations import quaternion_from_rotation, rotation_from_quaternion
from mapper.core.timebase import Stamps, ns_from_seconds_text, seconds_text_from_ns
from mapper.core.trajectory import Trajectory
from mapper.runtime.atomic import write_text
from mapper.runtime.regular_files import read_text


def read_tum(path: Path) -> Trajectory:
    """Read ``stamp tx ty tz qx qy qz qw`` lines (Sturm et al. 2012); quaternions are normalised.

    Of two poses with the same stamp the first counts: fr2_desk's truth rounds two samples to one stamp.

    Raises:
        DataError: A line that is not eight finite numbers, a zero quaternion, or stamps that decrease.
    """
    stamps_ns: list[int] = []
    poses: list[Transform] = []
    for number, words in _rows(path):
        if len(words) != 8:
            raise DataError(f"{path}:{number}: {len(words)} columns, want 8: stamp tx ty tz qx qy qz qw")
        try:
            stamps_ns.append(ns_from_seconds_text(words[0]))
            values = np.array([float(word) for word in words[1:]])
            if not np.isfinite(values).all():
                raise DataError("a number is not finite; remove the line")
            poses.append(transform(rotation_from_quaternion(values[3:]), values[:3]))
        except (DataError, ValueError) as error:
            raise DataError(f"{path}:{number}: {error}") from None
        if len(stamps_ns) > 1 and stamps_ns[-1] == stamps_ns[-2]:
            del stamps_ns[-1], poses[-1]
        elif len(stamps_ns) > 1 and stamps_ns[-1] < stamps_ns[-2]:
            raise DataError(f"{path}:{number}: stamp {words[0]} comes before the line above; sort the file")
    if not poses:
        raise DataError(f"{path}: no poses; want lines of stamp tx ty tz qx qy qz qw")
    return Trajectory(np.array(stamps_ns, dtype=np.int64), np.array(poses))


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write TUM text with exact stamps and every digit of the poses."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    quaternions = quaternion_from_rotation(trajectory.T_world_body[:, :3, :3])
    rows = np.column_stack([trajectory.positions_world, quaternions])
    for stamp_ns, row in zip(trajectory.stamps_ns.tolist(), rows.tolist(), strict=True):
        lines.append(" ".join([seconds_text_from_ns(stamp_ns), *map(repr, row)]))
    write_text(path, "\n".join(lines) + "\n")


def read_kitti(path: Path, stamps_ns: Stamps | None = None) -> Trajectory:
    """Read one row-major 3×4 matrix a line (Geiger et al. 2012).

    Args:
        path: Pose file.
        stamps_ns: (N,) times of the poses; without them pose i gets i nanoseconds, which only orders them.

    Raises:
        DataError: A line that is not twelve finite numbers, or another number of stamps than poses.
    """
    poses: list[Transform] = []
    for number, words in _rows(path):
        try:
            values = np.array([float(word) for word in words])
        except ValueError as error:
            raise DataError(f"{path}:{number}: {error}") from None
        if values.shape != (12,) or not np.isfinite(values).all():
            raise DataError(f"{path}:{number}: want 12 finite numbers, a row-major 3×4 pose")
        T = np.vstack([values.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        poses.append(T)
    if not poses:
        raise DataError(f"{path}: no poses; want lines of 12 numbers")
    stamps = np.arange(len(poses), dtype=np.int64) if stamps_ns is None else stamps_ns
    if len(stamps) != len(poses):
        raise DataError(
            f"{path}: {len(poses)} poses but {len(stamps)} stamps; the two must pair line by line"
        )
    if not is_rigid(np.array(poses), tolerance=1e-4):
        raise DataError(f"{path}: a pose is not a rigid motion; is this really KITTI's pose format?")
    return Trajectory(stamps, np.array([_orthonormal(T) for T in poses]))


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write one row-major 3×4 matrix a line, with every digit; KITTI text has no stamps."""
    rows = (" ".join(repr(float(v)) for v in T[:3].ravel()) for T in trajectory.T_world_body)
    write_text(path, "\n".join(rows) + "\n")


def _orthonormal(T: Transform) -> Transform:
    """Text with a few digits leaves rotations slightly off SO(3)."""
    return transform(rotation_from_quaternion(quaternion_from_rotation(T[:3, :3])), T[:3, 3])


def _rows(path: Path) -> Iterable[tuple[int, list[str]]]:
    for number, line in enumerate(read_text(path, may_be_pipe=True).splitlines(), start=1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            yield number, words
