"""Tracking of features that move by themselves, from frame to frame and over the body they are on."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Transform, apply, inverse
from mapper.core.timebase import NS_PER_S
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.pose.camera_motion import agreeing
from mapper.odometry.local_map.pose.local_search import LocalSearch, PredictedFeatures
from mapper.odometry.local_map.pose.moving_features import among_moving
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose, project

_MAX_RATIO = 0.9
_LEAST_RATIO = 0.15
"""While a smaller share of the features moves, they are not followed: on a real desk, which has many edges,
up to 0.12 seem to. 0.13 and 0.2 serve as well."""
_MAX_ELAPSED_NS = NS_PER_S // 5
"""After longer, features that moved are elsewhere, and others move only by the errors of a wide baseline."""


class MovingFeatureTracker:
    """Test which features move, by those of the last frame and by their neighbours.

    Depth images show a motion only where an earlier one saw through, and pairs only of features that match.
    The other features on a person would become landmarks, as many as those of the walls.
    """

    def __init__(self, config: LocalMapConfig, search: LocalSearch) -> None:
        self._config = config
        self._search = search

    def moving(
        self,
        T_camera_world: Transform,
        observation: ImageObservation,
        last: TrackedPose,
        is_moving: NDArray[np.bool_],
        is_still: NDArray[np.bool_],
        contradicts: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.bool_] | None:
        """Return (N,) which features of a frame move; None while next to none do, nor did in the last one.

        None also where the last frame was long ago.

        Args:
            T_camera_world: (4, 4) pose of the frame.
            observation: The frame.
            last: The frame before.
            is_moving: (N,) features that depth or pairs show to move.
            is_still: (N,) features that agree with the pose.
            contradicts: (N,) features that do not, mismatches among them; None if there are none.
        """
        if observation.stamp_ns - last.stamp_ns > _MAX_ELAPSED_NS:
            return None
        moved_before = len(last.moving) > _LEAST_RATIO * len(last.observation)
        if not moved_before and is_moving.sum() <= _LEAST_RATIO * len(observation):
            return None
        is_moving = is_moving.copy() if contradicts is None else is_moving | contradicts
        is_still = is_still & ~is_moving
        self._follow(T_camera_world, observation, last, is_moving, is_still)
        points = observation.points_camera
        return among_moving(points, points, is_moving, is_still)

    def _follow(
        self,
        T_camera_world: Transform,
        observation: ImageObservation,
        last: TrackedPose,
        is_moving: NDArray[np.bool_],
        is_still: NDArray[np.bool_],
    ) -> None:
        """Add the features that moved in the last frame: to those at rest where they are found there."""
        known = last.moving[last.observation.has_depth[last.moving]]
        for search_px in (self._config.local_search_px, self._config.search_px):
            points_world = apply(inverse(last.T_camera_world), last.observation.points_camera[known])
            predicted = PredictedFeatures(
                project(T_camera_world, points_world, observation.intrinsics),
                apply(T_camera_world, points_world)[:, 2],
                last.observation.octave[known],
                last.observation.bits[known],
            )
            feature = self._search.match_near(
                observation, predicted, search_px=search_px, taken=is_still | is_moving, max_ratio=_MAX_RATIO
            )
            hits = np.flatnonzero(feature >= 0)
            features = feature[hits]
            agree = agreeing(T_camera_world, points_world[hits], observation, features, observation.weights)
            if search_px == self._config.search_px:
                is_moving[features[~agree]] = True
            else:  # at rest: searched farther, many features of a wall match others of it
                is_still[features[agree]] = True
                known = np.delete(known, hits[agree])
