"""Tracking a log frame by frame."""
