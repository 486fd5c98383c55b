"""New logs in finished maps."""

from pathlib import Path

from mapper.api.progress import AnyProgress, receiver_of
from mapper.config.loading import Settings, overridden
from mapper.pipeline.known_map import load_known_map
from mapper.pipeline.localise import localise as localise_log
from mapper.run.folder import Run
from mapper.run.manifest import LocalisedManifest
from mapper.runtime.regular_files import AnyPath
from mapper.runtime.result_paths import RUNS, name_of, place_of
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.vehicle import clear_vehicle


def localise(
    log: Log | AnyPath,
    known: Run | AnyPath,
    *,
    out: AnyPath | None = None,
    settings: Settings | None = None,
    progress: AnyProgress = None,
    overwrite: bool = False,
) -> LocalisedManifest:
    """Place a new log in a finished map, as ``mapper localise`` does; ``OUT/trajectory.tum`` has its poses.

    Args:
        log: Recorded log, or its path, from the same kind of sensor as the map.
        known: Run, or folder of a run or a merged map; it is not changed.
        out: Folder to create; None is ``runs/LOG-in-RUN``, or with a number.
        settings: Values by dotted name on top of the map's.
        progress: As for ``mapper.build``.
        overwrite: Replace OUT.

    Returns:
        The result's manifest, with ``stretches`` and the ``verdict``.

    Raises:
        TrackingError: The log is of another place.
        MapperError: The log or the map cannot be read, or a setting is wrong.
    """
    receiver, path = receiver_of(progress), log.path if isinstance(log, Log) else Path(log)
    map_folder = known.path if isinstance(known, Run) else Path(known)
    usual = RUNS / f"{name_of(path)}-in-{name_of(map_folder)}"
    folder = place_of(None if out is None else Path(out), usual, overwrite=overwrite)
    finished = load_known_map(map_folder, progress=receiver)
    base = finished.config.model_copy(update={"source": SourceConfig()})
    config = overridden(base, settings=settings)
    source = log if isinstance(log, Log) else open_source(path, config.source)
    source, own = clear_vehicle(source, config.source)
    config = config.model_copy(update={"source": own})
    for note in source.sentences:
        receiver.note(note)
    return localise_log(source, finished, config, folder, progress=receiver, overwrite=overwrite)
