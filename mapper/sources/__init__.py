"""Recorded logs as sequences of frames."""
