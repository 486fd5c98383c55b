"""Earlier frames of ISVD odometry: which of them a new frame is registered against."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from mapper.core.geometry import Array
from mapper.odometry.config import IsvdOdometryConfig
from mapper.odometry.isvd.frames import Keyframe, TrackedFrame, kept
from mapper.odometry.sharpest_keyframe import SharpestKeyframes

_NEW_VIEW, _NEAR_VIEW = 0.15, 0.6
"""Differences of views: from this on a frame is a keyframe, up to this it is registered against one."""
_HALF_VIEW_RAD = 0.5


class EarlierFrames:
    """Earlier frames: the latest ones, and the keyframes of the whole path.

    With ``earlier = "frames"``, new frames are registered against the MP latest ones, and keyframes are the
    sharpest frames (Somlyai, PhD thesis, alg. 7 and §4.1.2). Otherwise they are registered against the latest
    one and the keyframes whose views are nearest, and a frame whose view is new becomes a keyframe.
    """

    def __init__(self, config: IsvdOdometryConfig) -> None:
        """Start before the first frame."""
        self._config = config
        self._by_view = config.earlier != "frames"
        self._latest: deque[TrackedFrame] = deque(
            maxlen=max(config.previous_frames, config.keyframe_interval)
        )
        self._keyframes: list[Keyframe] = []
        self._sharpest = SharpestKeyframes(config.keyframe_interval)
        self._turn = 0

    @property
    def last(self) -> TrackedFrame | None:
        """The frame before; None before the first."""
        return self._latest[-1] if self._latest else None

    def add(self, frame: TrackedFrame) -> None:
        """Add a tracked frame, and make it or one before it a keyframe where due."""
        is_new = self._by_view and not (self._view_differences(frame, self._keyframes) < _NEW_VIEW).any()
        self._latest.append(frame)
        if is_new:
            self._keyframes.append(kept(frame))
        elif not self._by_view:
            keyframe = self._sharpest.add(frame.node, len(frame.observation.features))
            self._keyframes.extend(kept(one) for one in self._latest if one.node == keyframe)

    def to_register(self) -> list[TrackedFrame]:
        """Return the MP earlier frames to register the next frame against, the one before it first."""
        count = self._config.previous_frames
        if not self._by_view:
            return list(self._latest)[-count:][::-1]
        last = self._latest[-1]
        keyframes = [keyframe for keyframe in self._keyframes if keyframe.node != last.node]
        differences = self._view_differences(last, keyframes)
        nearest = np.argsort(differences, kind="stable")[: count - 1]
        return [last, *(keyframes[i].loaded() for i in nearest if differences[i] <= _NEAR_VIEW)]

    def to_relocalise(self) -> list[Keyframe]:
        """Return the keyframes nearest to the last tracked pose, and some of the others in turn."""
        count = self._config.relocalisation_keyframes
        last_world = self._latest[-1].T_world_body[:3, 3]
        by_distance = sorted(
            self._keyframes, key=lambda k: float(np.linalg.norm(k.T_world_body[:3, 3] - last_world))
        )
        far = by_distance[count:]
        in_turn = [far[(self._turn + i) % len(far)] for i in range(min(count, len(far)))]
        self._turn += len(in_turn)
        return by_distance[:count] + in_turn

    @staticmethod
    def _view_differences(frame: TrackedFrame, others: Sequence[Keyframe]) -> Array:
        """Return (N,) differences of views: shift relative to the depth of the scene, plus turn."""
        if not others:
            return np.empty(0)
        poses = np.array([other.T_world_body for other in others])
        depth_m = np.nanmedian(frame.observation.depths_m)
        shift = np.linalg.norm(poses[:, :3, 3] - frame.T_world_body[:3, 3], axis=1) / depth_m
        traces = np.einsum("nij,ij->n", poses[:, :3, :3], frame.T_world_body[:3, :3])
        turn = np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)) / _HALF_VIEW_RAD
        difference: Array = shift + turn
        return difference
