"""Poses that no prediction leads to: relocalisation, gaps, wrong motions."""
