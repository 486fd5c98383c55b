"""Observation of one RGB-D frame: features, surfaces of its depth image, motion while its rows are read."""
