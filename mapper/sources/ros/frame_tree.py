"""Tree of the coordinate frames in tf."""

import re
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, inverse
from mapper.core.timebase import LATEST_NS, NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.sensing.wheel_kinematics import pose_at
from mapper.sources.ros.messages import PoseMessage
from mapper.sources.text import poses_from_numbers

BY_TF = "tf:"
"""Beginning of what names a coordinate frame where a topic is expected."""
_FIXED_FRAMES = frozenset(
    {"map", "odom", "world", "earth", "utm", "enu", "global", "combined", "init", "origin"}
)
"""Last words of frames that do not move with the robot: REP 105's, odom_combined of robot_pose_ekf,
camera_init of LOAM (Zhang & Singh 2014), local_origin of mavros, odom_frame of a T265."""
ESTIMATED = re.compile("map|laser|lidar|icp|rf2o|visual|camera|gps|gnss|truth|amcl|slam")
"""Words in names of odometry that is not of wheels, or not of them alone."""
_MAX_GAP_NS = NS_PER_S
"""Longer than any publisher of a moving frame pauses; tf2 keeps 10 s and interpolates over any gap."""
_SAME_POSE = 1e-6


def is_fixed(frame: str) -> bool:
    """Return whether a frame's name says that it does not move with the robot."""
    words = re.findall("[a-z]+", frame.lower())
    return bool(words) and words[-2 if words[-1] == "frame" and words[1:] else -1] in _FIXED_FRAMES


def is_of_wheels(frame: str) -> bool:
    """Return whether a frame's name says that the wheels' odometry is given in it: odom, odom_combined."""
    words = re.findall("[a-z]+", frame.lower())
    return not {"odom", "odometry"}.isdisjoint(words) and not ESTIMATED.search(frame.lower())


class FrameTree:
    """Tree of coordinate frames; those that move in their parent keep their poses over time.

    Attributes:
        damaged: Parents and children, "parent → child", between which no pose is finite and rigid.
        contradicted: What is told twice and differently, "parent → child" or "child in parent, not in
            another": of a static frame the last counts, as in tf2, of another the first.
    """

    def __init__(self, poses: Iterable[PoseMessage]) -> None:
        """Keep the poses of every frame in one parent; static ones have stamp 0."""
        told = list(poses)
        numbers = np.array([pose.numbers for pose in told], np.float64).reshape(-1, 7)
        links: dict[tuple[str, str], dict[int, Transform]] = {}
        parents: dict[str, str] = {}
        contradicted: dict[str, None] = {}
        for pose, T in zip(told, poses_from_numbers(numbers), strict=True):
            child, parent = pose.child.lstrip("/"), pose.parent.lstrip("/")
            found = links.setdefault((child, parent), {})
            if T is None:
                continue
            stamp_ns = min(max(pose.stamp_ns, 0), LATEST_NS)
            first = found.setdefault(stamp_ns, T)
            if first is not T and not np.allclose(first, T, atol=_SAME_POSE):
                contradicted[f"{parent} → {child}"] = None
            parents.setdefault(child, parent)
            if stamp_ns == 0:
                found[0], parents[child] = T, parent
        self.damaged = [f"{parent} → {child}" for (child, parent), found in links.items() if not found]
        self._parents: dict[str, tuple[str, Trajectory]] = {}
        for (child, parent), found in links.items():
            if found and parent != parents[child]:
                contradicted[f"{child} in {parents[child]}, not in {parent}"] = None
            elif found:
                path, stays = [*found.items()], np.ptp([*found.values()], axis=0).max() < _SAME_POSE
                kept = trajectory_from(path[:1] if stays else sorted(path, key=itemgetter(0)))
                self._parents[child] = parent, kept
        self.contradicted = list(contradicted)

    @property
    def frames(self) -> Sequence[str]:
        """Every frame, in order of name."""
        return sorted(self._parents.keys() | {parent for parent, _ in self._parents.values()})

    def find(self, to: str, from_: str, *, stamp_ns: int | None = None) -> Transform | None:
        """Return T_to_from, the pose of one frame in another.

        Args:
            to: The frame in which the pose is given.
            from_: The frame whose pose it is.
            stamp_ns: Time for which poses of frames that move are interpolated; None takes their first.

        Returns:
            None where nothing connects the two, or where one moves and its pose at that time is unknown.
        """
        T_ancestor_to, T_ancestor_from = self._ancestors(to, stamp_ns), self._ancestors(from_, stamp_ns)
        for ancestor, T_a_from in T_ancestor_from.items():
            if ancestor in T_ancestor_to:
                return inverse(T_ancestor_to[ancestor]) @ T_a_from
        return None

    def find_each(self, to: str, from_: str, stamps_ns: Stamps) -> tuple[NDArray[np.bool_], Array]:
        """Return at which of some times T_to_from is known, and (N, 4, 4) T_to_from at these."""
        times: list[int | None] = stamps_ns.tolist() if self.moves(to, from_) else [None]
        found = [self.find(to, from_, stamp_ns=time) for time in times]
        known = np.broadcast_to([T is not None for T in found], stamps_ns.shape)
        T_to_from = np.array([T for T in found if T is not None]).reshape(-1, 4, 4)
        return known, np.broadcast_to(T_to_from, (int(known.sum()), 4, 4))

    def moves(self, to: str, from_: str) -> bool:
        """Return whether one frame moves in another that is connected to it."""
        between = self._ancestors(to).keys() ^ self._ancestors(from_).keys()
        return self.find(to, from_) is not None and any(map(self._moves_in_parent, between))

    def path_in(self, fixed: str, frame: str) -> Trajectory | None:
        """Return the poses of a frame in one that it moves in, at the times of tf; None if it does not."""
        chain = list(self._ancestors(frame))
        if fixed not in chain or not self.moves(fixed, frame):
            return None
        links = [self._parents[one][1] for one in chain[: chain.index(fixed)]]
        stamps_ns = max(links, key=len).stamps_ns
        known, T_fixed_frame = self.find_each(fixed, frame, stamps_ns)
        return Trajectory(stamps_ns[known], T_fixed_frame)

    def moving_above(self, frame: str) -> list[str]:
        """Return the frames above one in which it moves, the nearest first."""
        return [above for above in self._ancestors(frame) if self.moves(above, frame)]

    def carried_by(self, fixed: str) -> str | None:
        """Return the frame nearest below a fixed one that moves in it; None without one."""
        moving = filter(self._moves_in_parent, self._parents)
        below = [
            (len(chain), child) for child in moving if fixed.lstrip("/") in (chain := self._ancestors(child))
        ]
        return min(below)[1] if below else None

    def _moves_in_parent(self, frame: str) -> bool:
        return frame in self._parents and len(self._parents[frame][1]) > 1

    def _ancestors(self, frame: str, stamp_ns: int | None = None) -> Mapping[str, Transform]:
        """Return the pose of a frame in itself, its parent, its parent's parent and so on."""
        frame = frame.lstrip("/")
        T = np.eye(4)
        found = {frame: T}
        while frame in self._parents:
            frame, path = self._parents[frame]
            T_parent_frame: Transform | None = path[0]
            if len(path) > 1 and stamp_ns is not None:
                T_parent_frame = pose_at(path, stamp_ns, max_gap_ns=_MAX_GAP_NS)
            if frame in found or T_parent_frame is None:
                break
            T = T_parent_frame @ T
            found[frame] = T
        return found
