"""Odometry by iterative SVD on matched features."""
