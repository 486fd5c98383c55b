"""Metrics of trajectories, maps, loops and registrations."""
