"""Edits by hand of a finished run's maps: fused again, but not tracked."""

from mapper.mapping.config import EditKind, Region
from mapper.pipeline.fuse import fuse_changed
from mapper.run.edits_file import edits_text, with_region, without_last
from mapper.run.folder import Run
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log


def add_region(source: Log, run: Run, kind: EditKind, region: Region, *, progress: Progress = SILENT) -> Run:
    """Add a region to a run's ``edits.toml`` and make its maps again; the run stays as it is if that fails.

    Args:
        source: The log that the run was built from.
        run: A finished run.
        kind: Kind of the edit.
        region: The region.
        progress: Receives stages, counts and notes.

    Raises:
        ConfigError: The run's edits are not valid.
        DataError: They would leave nothing of the map.
        RunError: The log is not the one that the run was built from.
    """
    text = with_region(edits_text(run.path), run.path, kind, region)
    return fuse_changed(source, run, edits=text, progress=progress)


def undo_region(source: Log, run: Run, *, progress: Progress = SILENT) -> Run:
    """Take the last region of a run's ``edits.toml`` back and make its maps again; see ``add_region``.

    Raises:
        ConfigError: There is none, or the run's edits are not valid.
        RunError: The log is not the one that the run was built from.
    """
    return fuse_changed(source, run, edits=without_last(edits_text(run.path), run.path), progress=progress)
