"""Executors, ordered parallel maps, progress, timing, and files that are written whole or not at all."""
