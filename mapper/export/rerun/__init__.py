"""A run as a Rerun recording: finished, or while it is being built."""

from mapper.runtime.extras import extra

with extra("viewer", "a Rerun recording"):
    import rerun  # noqa: F401
