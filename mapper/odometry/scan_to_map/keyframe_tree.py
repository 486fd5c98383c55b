"""Tree of the last keyframes, each under the one that it was compared with."""

from collections import deque
from dataclasses import dataclass

from mapper.core.geometry import Array, Transform, adjoint, inverse


class KeyframeTree:
    """The last keyframes' poses, with the covariance of each relative to the one it was compared with."""

    def __init__(self, most: int) -> None:
        """Begin without keyframes, to keep the last ``most``."""
        self._steps: deque[_Step] = deque(maxlen=most)

    def clear(self) -> None:
        """Forget all."""
        self._steps.clear()

    def add(self, node: int, parent: int, T_world_body: Transform, covariance: Array) -> Array:
        """Add a keyframe; return its (6, 6) covariance relative to the one added before it.

        It is that of the factors on the way between both. A keyframe may be compared with one before the
        last, so that the way to it and the way back to the last have parts in common, which count once: if
        they counted twice, covariances would double with every few keyframes.

        Args:
            node: Its number.
            parent: Number of the keyframe that it was compared with.
            T_world_body: (4, 4) its pose.
            covariance: (6, 6) relative to the parent, in its tangent.
        """
        last = self._steps[-1].node if self._steps else parent
        one, other, total = parent, last, covariance
        for step in reversed(self._steps):
            if one == other:
                break
            if step.node not in (one, other):
                continue
            Ad = adjoint(inverse(T_world_body) @ step.T_world_body)
            total = total + Ad @ step.covariance @ Ad.T
            one, other = (step.parent, other) if step.node == one else (one, step.parent)
        self._steps.append(_Step(node, parent, T_world_body, covariance))
        return total


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A keyframe with its (6, 6) covariance relative to its parent."""

    node: int
    parent: int
    T_world_body: Transform
    covariance: Array
