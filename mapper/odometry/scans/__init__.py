"""LiDAR odometry: each scan is registered to a map of those before it."""
