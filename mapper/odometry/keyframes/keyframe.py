"""Keyframe of the local map, and what was observed in the last ones that were used."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, inverse
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.runtime.archived import Archived

_READY = 32
"""Keyframes whose observations are ready: those that tracking compares with, and the windows of refining."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthLink:
    """Relative pose of two keyframes from their depth images.

    Attributes:
        reference: The keyframe that the depth image was aligned to.
        T_camera_reference: (4, 4) from its camera to the camera of the keyframe that has the link.
        information: (6, 6) of the latter's tangent (rotation, translation).
    """

    reference: int
    T_camera_reference: Transform
    information: Array


@dataclass(slots=True, eq=False)
class Keyframe:
    """A frame that stays in the map.

    Attributes:
        stamp_ns: The frame's stamp.
        T_body_camera: (4, 4) pose of the camera in the body frame.
        unswept: Its features, before any motion is taken out.
        sweep_camera: (6,) motion of the camera while the rows were read, as it is known now.
        T_camera_world: (4, 4) current estimate.
        landmark_of_feature: (N,) int32 landmark of each feature, −1 for none.
        origin: First keyframe of its sub-map; sub-maps are not connected to each other.
        twist_camera: (6,) velocity of the camera in its own axes, rad/s and m/s; 0 if it is unknown.
        depth_link: Pose relative to an earlier keyframe by depth; None if the landmarks were many.
        doubt_rad: Error of its rotation that speaks against it; 0 if its pose is not doubtful.
        doubt_m: Error of its translation.
    """

    stamp_ns: int
    T_body_camera: Transform
    unswept: Archived[ImageObservation]
    sweep_camera: Array
    T_camera_world: Transform
    landmark_of_feature: NDArray[np.int32]
    origin: int
    twist_camera: Array
    depth_link: DepthLink | None = None
    doubt_rad: float = 0.0
    doubt_m: float = 0.0

    @property
    def body_pose(self) -> Transform:
        """(4, 4) T_world_body, as it is estimated now."""
        return inverse(self.T_body_camera @ self.T_camera_world)


class RecentObservations:
    """What was observed in the last keyframes that were used, by the readout time as it is known now."""

    def __init__(self) -> None:
        self._ready: OrderedDict[int, ImageObservation] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Return nothing: all follows from the keyframes."""
        return {"_ready": OrderedDict()}

    def of(self, index: int, keyframe: Keyframe) -> ImageObservation:
        """Return what was observed in a keyframe.

        Raises:
            DataError: It is on the disk, and cannot be read.
        """
        found = self._ready.get(index)
        if found is None:
            found = keyframe.unswept.data.swept(keyframe.sweep_camera)
            self.keep(index, found)
        else:
            self._ready.move_to_end(index)
        return found

    def keep(self, index: int, observation: ImageObservation) -> None:
        """Keep an observation ready, instead of the one that was used least lately."""
        self._ready[index] = observation
        if len(self._ready) > _READY:
            self._ready.popitem(last=False)

    def clear(self) -> None:
        """Forget all, as where the readout time has changed."""
        self._ready.clear()
