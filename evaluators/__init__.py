"""Measure what `mapper` makes: trajectories, maps, and the published tables."""
