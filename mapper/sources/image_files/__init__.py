"""Readers of image files: PNG and JPEG as arrays, with every pixel checked."""
