"""Tree of the coordinate frames in tf."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from mapper.core.geometry import Transform, inverse
from mapper.sources.ros.messages import PoseMessage
from mapper.sources.text import pose_from_numbers


class FrameTree:
    """Tree of coordinate frames, each at its first pose, for what is mounted on a robot does not move."""

    def __init__(self, poses: Iterable[PoseMessage]) -> None:
        """Keep the first pose of every frame in its parent."""
        self._parents: dict[str, tuple[str, Transform]] = {}
        for pose in poses:
            child, parent = pose.child.lstrip("/"), pose.parent.lstrip("/")
            if child not in self._parents:
                T_parent_child = pose_from_numbers(np.array(pose.numbers))
                if T_parent_child is not None:
                    self._parents[child] = (parent, T_parent_child)

    @property
    def frames(self) -> Sequence[str]:
        """Every frame, in order of name."""
        return sorted(self._parents.keys() | {parent for parent, _ in self._parents.values()})

    def find(self, to: str, from_: str) -> Transform | None:
        """Return T_to_from, the pose of one frame in another; None where nothing connects them."""
        T_ancestor_to, T_ancestor_from = self._ancestors(to), self._ancestors(from_)
        for ancestor, T_a_from in T_ancestor_from.items():
            if ancestor in T_ancestor_to:
                return inverse(T_ancestor_to[ancestor]) @ T_a_from
        return None

    def _ancestors(self, frame: str) -> Mapping[str, Transform]:
        """Return the pose of a frame in itself, its parent, its parent's parent and so on."""
        frame = frame.lstrip("/")
        T = np.eye(4)
        found = {frame: T}
        while frame in self._parents:
            frame, T_parent_frame = self._parents[frame]
            if frame in found:
                break
            T = T_parent_frame @ T
            found[frame] = T
        return found
