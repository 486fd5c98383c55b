"""Pose of a frame from its features: prediction, search, motion of the camera among others, covariance."""
