"""The steps of a build: track, solve, level, fuse; and what changes a finished run."""
