"""Trajectory: a body's poses over time."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Transform, interpolate, inverse, is_rigid, path_length
from mapper.core.timebase import NS_PER_S, Stamps

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plan_axes(axes: "Axes | None") -> "Axes":
    """Return axes of x and y in metres, of equal scale: those given, or of a new figure of pyplot's."""
    if axes is None:
        import matplotlib.pyplot as plt  # keeps global state, which only a caller without axes needs

        axes = plt.subplots(layout="constrained")[1]
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    return axes


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of the body in the world, one per stamp.

    ``trajectory[i]`` is one pose, (4, 4); a slice, a mask or an array of increasing indices gives a
    trajectory. Iterating gives the poses.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing nanoseconds.
        T_world_body: (N, 4, 4) float64 rigid motions.
    """

    stamps_ns: Stamps
    T_world_body: Array

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        if self.stamps_ns.shape != (n,) or self.T_world_body.shape != (n, 4, 4):
            raise DataError(
                f"trajectory: stamps {self.stamps_ns.shape} and poses {self.T_world_body.shape}, "
                "want (N,) and (N, 4, 4)"
            )
        backwards = np.flatnonzero(np.diff(self.stamps_ns) <= 0)
        if len(backwards):
            i = int(backwards[0])
            raise DataError(
                f"trajectory: stamp {self.stamps_ns[i + 1]} comes after {self.stamps_ns[i]}; "
                "stamps must increase"
            )
        if n and not is_rigid(self.T_world_body):
            raise DataError("trajectory: a pose is not a finite rigid motion")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @overload
    def __getitem__(self, index: int) -> Transform: ...
    @overload
    def __getitem__(self, index: slice | NDArray[Any]) -> "Trajectory": ...
    def __getitem__(self, index: Any) -> "Transform | Trajectory":
        if isinstance(index, int | np.integer):
            pose: Transform = self.T_world_body[index]
            return pose
        return replace(self, stamps_ns=self.stamps_ns[index], T_world_body=self.T_world_body[index])

    def __iter__(self) -> Iterator[Transform]:
        return iter(self.T_world_body)

    def __repr__(self) -> str:
        if not len(self):
            return "Trajectory of no poses"
        lasted_s = int(self.stamps_ns[-1] - self.stamps_ns[0]) / NS_PER_S
        return f"Trajectory of {len(self)} poses over {lasted_s:.1f} s and {self.path_length_m:.2f} m"

    def items(self) -> Iterator[tuple[int, Transform]]:
        """Yield the stamp and the (4, 4) pose of every moment."""
        return zip(self.stamps_ns.tolist(), self.T_world_body, strict=True)

    def during(self, first_ns: int, last_ns: int) -> "Trajectory":
        """Return the poses from one time to another, both included."""
        return self[(self.stamps_ns >= first_ns) & (self.stamps_ns <= last_ns)]

    def at(self, stamp_ns: int) -> Transform:
        """Return the (4, 4) pose at a time, nanoseconds, interpolated between those before and after it.

        Raises:
            DataError: It is before the first pose or after the last.
        """
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if after < len(self) and self.stamps_ns[after] == stamp_ns:
            return self[after]
        if not 0 < after < len(self):
            begin_ns, end_ns = self.stamps_ns[[0, -1]].tolist() if len(self) else (0, 0)
            raise DataError(
                f"trajectory: no pose at {stamp_ns} ns; want {begin_ns} … {end_ns} ns (stamps_ns)"
            )
        begin_ns, end_ns = self.stamps_ns[[after - 1, after]].tolist()
        return interpolate(self[after - 1], self[after], (stamp_ns - begin_ns) / (end_ns - begin_ns))

    def interpolate(self, stamps_ns: Iterable[int]) -> "Trajectory":
        """Return the poses at other times, as :meth:`at` does, in increasing order.

        Raises:
            DataError: As :meth:`at`, or the times do not increase.
        """
        return trajectory_from((int(stamp_ns), self.at(stamp_ns)) for stamp_ns in stamps_ns)

    def write(self, path: str | PathLike[str]) -> None:
        """Write the trajectory, atomically: as TUM text (".tum", ".txt") or KITTI text (".kitti").

        Raises:
            DataError: Another ending.
        """
        writers = import_module("mapper.sources.trajectory_files")  # which imports this module
        ending = Path(path).suffix.lower()
        if ending not in (".tum", ".txt", ".kitti"):
            raise DataError(f"{path}: want a name that ends in .tum, .txt or .kitti")
        (writers.write_kitti if ending == ".kitti" else writers.write_tum)(Path(path), self)

    @property
    def stamps(self) -> Array:
        """(N,) float64 seconds, for plots: those of Unix time are rounded by up to 120 ns."""
        return self.stamps_ns / NS_PER_S

    @property
    def poses(self) -> Array:
        """(N, 4, 4) rigid motions: ``T_world_body``."""
        return self.T_world_body

    @property
    def positions(self) -> Array:
        """(N, 3) metres, world frame: ``positions_world``."""
        return self.positions_world

    @property
    def positions_world(self) -> Array:
        """(N, 3) metres, world frame."""
        return self.T_world_body[:, :3, 3]

    @property
    def path_length_m(self) -> float:
        """Length of the straight segments between consecutive positions."""
        return path_length(self.positions_world)

    def moved(self, T_new_world: Transform) -> "Trajectory":
        """Return the same motion in another world frame."""
        return replace(self, T_world_body=T_new_world @ self.T_world_body)

    def plot(self, axes: "Axes | None" = None) -> "Axes":
        """Draw the path seen from above, with a disc at its start and a square at its end.

        Args:
            axes: Matplotlib's axes to draw on; None makes a figure of pyplot's.

        Returns:
            The axes, in metres of the world.
        """
        axes = plan_axes(axes)
        x, y = self.positions_world[:, 0], self.positions_world[:, 1]
        (line,) = axes.plot(x, y)
        axes.plot(x[:1], y[:1], "o", color=line.get_color())
        axes.plot(x[-1:], y[-1:], "s", color=line.get_color())
        return axes


class Positions(Trajectory):
    """Trajectory of which positions alone are known, as of a total station: its rotations mean nothing."""

    __slots__ = ()


def without_idle_rotations(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory as positions alone if all of its rotations are exactly the identity."""
    is_idle = len(trajectory) > 2 and (trajectory.T_world_body[:, :3, :3] == np.eye(3)).all()
    return Positions(trajectory.stamps_ns, trajectory.T_world_body) if is_idle else trajectory


def with_rotations(trajectory: Trajectory | None) -> Trajectory | None:
    """Return a trajectory that has rotations; None of positions alone, and of none."""
    return None if isinstance(trajectory, Positions) else trajectory


def trajectory_from(poses: Iterable[tuple[int, Transform]]) -> Trajectory:
    """Return a trajectory from (stamp_ns, T_world_body) pairs in time order."""
    pairs = list(poses)
    stamps_ns = np.array([stamp for stamp, _ in pairs], dtype=np.int64)
    return Trajectory(stamps_ns, np.array([T for _, T in pairs]).reshape(-1, 4, 4))


NO_POSES = Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4)))


def carried(trajectory: Trajectory, T_body_other: Transform | Trajectory) -> Trajectory:
    """Return the poses of a frame on the body; where it moves there, at the stamps that both have."""
    if not isinstance(T_body_other, Trajectory):
        return Trajectory(trajectory.stamps_ns, trajectory.T_world_body @ T_body_other)
    stamps_ns, i, j = np.intersect1d(
        trajectory.stamps_ns, T_body_other.stamps_ns, assume_unique=True, return_indices=True
    )
    return Trajectory(stamps_ns, trajectory.T_world_body[i] @ T_body_other.T_world_body[j])


def start_to_end(trajectory: Trajectory) -> Transform:
    """Return T_start_end, the last pose in the frame of the first."""
    T_start_end: Transform = inverse(trajectory.T_world_body[0]) @ trajectory.T_world_body[-1]
    return T_start_end
