"""A run as a Rerun recording: finished, or while it is being built."""
