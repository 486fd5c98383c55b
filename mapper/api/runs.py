"""What is made of a finished run; methods of :class:`~mapper.run.folder.Run` call these."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from mapper.api.progress import AnyProgress, receiver_of
from mapper.config.loading import Settings, checked_config, overridden
from mapper.core.errors import ConfigError
from mapper.core.trajectory import Trajectory
from mapper.export.exporters import export as export_kind
from mapper.export.report.data import chapter_of
from mapper.export.report.map_page import write_map_page
from mapper.mapping.config import EditKind, Region
from mapper.merging.map_page import write_merged_map_page
from mapper.merging.merged_map import open_map
from mapper.pipeline.edit import add_region, undo_region
from mapper.pipeline.fuse import fuse as fuse_run
from mapper.run.folder import Run, open_run
from mapper.run.manifest import is_merged_map
from mapper.runtime.atomic import refuse_existing
from mapper.runtime.regular_files import AnyPath
from mapper.runtime.result_paths import distinct_names


def export(run: Run, kind: str, path: AnyPath | None, *, progress: AnyProgress, **options: Any) -> Path:
    """Write a run for another program; see :meth:`mapper.run.folder.Run.export`."""
    out = None if path is None else Path(path)
    return export_kind(run, kind, out, progress=receiver_of(progress), **options)


def fuse(run: Run, *, settings: Settings | None, trajectory: Trajectory | None, progress: AnyProgress) -> Run:
    """Make a run's maps again; see :meth:`mapper.run.folder.Run.fuse`."""
    config = overridden(run.config, settings=settings)
    return fuse_run(run.open_log(), run, config, trajectory=trajectory, progress=receiver_of(progress))


def edit(run: Run, kind: Any, region: dict[str, Any], *, progress: AnyProgress) -> Run:
    """Edit a run's maps by hand; see :meth:`mapper.run.folder.Run.edit`."""
    receiver = receiver_of(progress)
    if kind == "undo" and not region:
        return undo_region(run.open_log(), run, progress=receiver)
    if kind not in get_args(EditKind):
        raise ConfigError(f"edit {kind!r}: want {', '.join(get_args(EditKind))}, or undo without a region")
    return add_region(run.open_log(), run, kind, checked_config(region, Region, "region"), progress=receiver)


def write_page(runs: Sequence[AnyPath], path: AnyPath | None = None, *, overwrite: bool = False) -> Path:
    """Write the map of some runs, or a merged map, as a page in 3D for any browser, and return its path.

    Args:
        runs: Run folders, or one merged map.
        path: HTML file to write; None is ``RUN.html`` in the current folder.
        overwrite: Replace a file that is there.

    Raises:
        RunError: The file is there already, or a folder is no run.
        MapperError: A file of a run cannot be read.
    """
    folders = [Path(run) for run in runs]
    path = Path(f"{folders[0].resolve().name}.html" if path is None else path)
    refuse_existing(path, overwrite=overwrite)
    if len(folders) == 1 and is_merged_map(folders[0]):
        merged = open_map(folders[0])
        write_merged_map_page(path, merged, distinct_names([Path(run.path) for run in merged.manifest.runs]))
        return path
    names = distinct_names(folders)
    write_map_page(
        path, [chapter_of(open_run(run), name, ()) for run, name in zip(folders, names, strict=True)]
    )
    return path
