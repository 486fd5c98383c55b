"""Odometry for scans: each is placed in a map of those before it."""
