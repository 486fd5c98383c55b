"""Alignment of depth images, and their comparison with earlier ones."""
