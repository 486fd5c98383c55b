"""Odometry: frame-by-frame tracking of a log."""
