"""Pixels of a frame's landmarks in an earlier frame, for display."""

import numpy as np

from mapper.core.geometry import Array
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose


def previous_pixels(landmark_map: LandmarkMap, now: TrackedPose, before: TrackedPose | None) -> Array:
    """Return (N, 2) pixels of a frame's landmarks in the frame before, or else in a keyframe; NaN if in none.

    Args:
        landmark_map: The map.
        now: The frame.
        before: The frame before it; None if that was lost.
    """
    landmarks = now.landmark_of_feature
    previous_px = np.full((len(landmarks), 2), np.nan)
    earlier = [(landmark_map.landmark_of_feature(now.reference), landmark_map.observation(now.reference))]
    if before is not None:
        ids = before.landmark_of_feature
        if landmark_map.keyframes[before.reference].stamp_ns == before.stamp_ns:
            ids = landmark_map.landmark_of_feature(before.reference)  # refining may have dropped some
        earlier.append((ids, before.observation))
    for ids, observation in earlier:
        if observation.stamp_ns != now.stamp_ns:
            common, here, there = np.intersect1d(landmarks, ids, return_indices=True)
            here, there = here[common >= 0], there[common >= 0]
            previous_px[here] = observation.pixels[there]
    return previous_px
