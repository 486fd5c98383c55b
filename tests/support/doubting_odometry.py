"""Odometry whose frames are doubted on request: some poses are moved, and say so."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.core.geometry import Transform
from mapper.odometry.factory import odometry_for
from mapper.pipeline import track

DOUBTS = (
    Doubt("jump", "jump of 0.50 m where 0.02 m was predicted"),
    Doubt("disagreement", "12 inliers on one side of the image"),
)
SIGMAS = np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5])


class DoubtingOdometry:
    """Moves and doubts the frames of some indices, unless they become keyframes; passes on all else.

    The motions are in the body's frame. Keyframes among ``doubted_keyframes`` are doubted where they are.
    """

    def __init__(
        self,
        odometry: Any,
        moved: Mapping[int, Transform],
        doubted_keyframes: frozenset[int] = frozenset(),
    ) -> None:
        self._odometry, self._moved, self._doubted = odometry, moved, doubted_keyframes
        self._index = -1

    def __getattr__(self, name: str) -> Any:
        return getattr(self._odometry, name)

    def track(self, observation: Any) -> Any:
        """Track the frame, and doubt it if it is one of those."""
        self._index += 1
        result = self._odometry.track(observation)
        if self._index in self._doubted and result.is_keyframe:
            return replace(result, doubts=DOUBTS[:1], covariance=np.diag(SIGMAS**2))
        if self._index not in self._moved or result.is_keyframe:
            return result
        T_body_moved = self._moved[self._index]
        return replace(
            result,
            T_node_body=result.T_node_body @ T_body_moved,
            T_world_body=result.T_world_body @ T_body_moved,
            doubts=DOUBTS,
            covariance=np.diag(SIGMAS**2),
        )


def doubt_frames(
    patch: pytest.MonkeyPatch,
    moved: Mapping[int, Transform],
    doubted_keyframes: frozenset[int] = frozenset(),
) -> None:
    """Let every odometry that is built from now on be a doubting one."""
    patch.setattr(
        track,
        "odometry_for",
        lambda *arguments: DoubtingOdometry(odometry_for(*arguments), moved, doubted_keyframes),
    )
