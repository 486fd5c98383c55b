"""The motion between two observations."""
