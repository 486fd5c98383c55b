"""From a log to a run, by a caller's own odometry if one is given."""

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mapper.api.logs import open_log
from mapper.api.progress import AnyProgress, receiver_of
from mapper.config.build import BuildConfig
from mapper.config.loading import Settings, load_config, overridden
from mapper.core.config import flattened
from mapper.core.errors import (
    ConfigError,
    DataError,
    FrameError,
    MapperWarning,
    TrackingError,
    ViewerError,
)
from mapper.core.frames import Frame
from mapper.core.geometry import Transform, is_rigid
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.export.preview import PREVIEW, Preview
from mapper.odometry.base import Odometry
from mapper.pipeline.build import build as build_run
from mapper.run import files
from mapper.run.folder import Run, open_run
from mapper.run.observers import NULL_OBSERVER, Observer, Observers
from mapper.runtime.atomic import partial_of, refuse_existing
from mapper.runtime.kernels import note_compilation
from mapper.runtime.progress import Progress
from mapper.runtime.regular_files import AnyPath
from mapper.runtime.result_paths import RUNS, name_of, place_of
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig


def poses_of(track: Callable[[Frame], ArrayLike | None], log: Log, *, progress: Progress) -> Trajectory:
    """Return the poses that a function gives a log's frames, called once for each in time order.

    Args:
        track: Takes a frame; returns (4, 4) T_world_body, or None where there is none.
        log: The log; frames that cannot be read are left out.
        progress: Receives the stage and its counts.

    Raises:
        DataError: It returns something else.
        TrackingError: It places fewer than two frames.
    """
    poses: list[tuple[int, Transform]] = []
    with progress.stage("odometry") as report:
        for done, entry in enumerate(log.entries(), start=1):
            report(done, len(log))
            try:
                frame = entry.load()
            except FrameError:
                continue  # tracking reports it
            found = track(frame)
            if found is not None:
                poses.append((entry.stamp_ns, _rigid(found, entry.stamp_ns)))
    if len(poses) < 2:
        raise TrackingError(
            f"odometry: placed {len(poses)} of {len(log)} frames, want at least 2; it returns (4, 4), or None"
        )
    return trajectory_from(poses)


def _rigid(found: ArrayLike, stamp_ns: int) -> Transform:
    try:
        T_world_body = np.array(found, dtype=np.float64)
    except (TypeError, ValueError):
        T_world_body = np.empty(0)
    if T_world_body.shape != (4, 4):
        raise DataError(f"odometry: frame {stamp_ns}: a pose of shape {np.shape(T_world_body)}, want (4, 4)")
    if not is_rigid(T_world_body):
        raise DataError(f"odometry: frame {stamp_ns}: the pose is not a finite rigid motion")
    return T_world_body


OwnOdometry = Odometry[Any] | Callable[[Frame], ArrayLike | None] | Trajectory
"""A caller's odometry: an object, a function of one frame after the other, or poses."""

_OWN_POSES: Mapping[str, Any] = {
    "odometry.kind": "given",
    "odometry.least_m": 0.01,
    "odometry.path_share": 0.01,
    "odometry.least_rad": 0.005,
    "odometry.turn_share": 0.01,
    "odometry.rad_per_m": 0.002,
}
"""Odometry drifts, unlike the motion capture that ``odometry.kind=given`` expects: loops may mend 1 %."""


def build(
    log: Log | AnyPath,
    *,
    out: AnyPath | None = None,
    config: BuildConfig | Settings | AnyPath | None = None,
    settings: Settings | None = None,
    onto: Run | AnyPath | None = None,
    odometry: OwnOdometry | None = None,
    rerun: str | None = None,
    progress: AnyProgress = None,
    observer: Observer = NULL_OBSERVER,
    overwrite: bool = False,
    fresh: bool = False,
) -> Run:
    """Build a run: track every frame, close loops, solve the graph once, and fuse all frames into the maps.

    A build that was stopped is resumed, unless it has an odometry of its own.

    Args:
        log: A log, or its path; see :func:`open_log`. An open log is mapped as it is; give
            the ``source`` settings by which it was opened, too, if the run is to find the same frames later.
        out: Run folder to create, called ``OUT.partial`` until it is complete. None is ``runs/LOG``, with a
            number if that exists.
        config: All settings, or a TOML or JSON file of them, or a mapping of some as ``settings`` takes it;
            None is what suits the log's sensor.
        settings: Values by dotted name on top, such as ``{"octree.resolution_m": 0.1}``.
        onto: Run of the same place that the log is appended to: OUT then holds both, by that run's settings.
        odometry: Your own instead of the toolkit's: an object of the
            :class:`~mapper.odometry.base.Odometry` protocol; or a function that is called with each frame in
            turn and returns the body's pose in a world of its own, (4, 4), or None where it is lost; or a
            :class:`~mapper.core.trajectory.Trajectory`. Poses are assumed to drift by 1 % of the path;
            ``odometry.least_m``, ``path_share`` and so on change that.
        rerun: Where Rerun shows the build while it runs: "FILE.rrd", "spawn", "connect" or "connect:URL".
        progress: Receives stages, counts and notes; or a function that is called with lines of text, such
            as ``print``. None is silent.
        observer: Receives every tracked frame and the results.
        overwrite: Replace an existing run, and the .rrd file, once the new one is complete.
        fresh: Begin anew, even if a stopped build could be resumed.

    Returns:
        The finished run; :attr:`Run.verdict <mapper.run.folder.Run.verdict>` says whether to trust it.

    Raises:
        SourceError: The log cannot be opened.
        ConfigError: A setting is unknown, has no such value, or does not fit the log; or an argument has no
            meaning with ``onto``.
        TrackingError: Too few frames could be tracked; the partial results stay in ``OUT.partial``.
        LoopError: No loop connects the log with the run that it is appended to.
        RunError: OUT exists already, or cannot be made.
        ViewerError: No viewer can be started or reached. One that goes away later is a MapperWarning.

    Example:
        >>> run = mapper.build(log_folder, out=new_folder, settings={"octree.resolution_m": 0.1})
        >>> run.verdict.state
        'trusted'
    """
    receiver = receiver_of(progress)
    path = log.path if isinstance(log, Log) else Path(log)
    out = place_of(None if out is None else Path(out), RUNS / name_of(path), overwrite=overwrite)
    if onto is not None:
        for name, value in (("config", config), ("odometry", odometry), ("rerun", rerun), ("fresh", fresh)):
            if value:
                raise ConfigError(f"{name}: has no meaning with onto")
        return _append(log, onto, out, settings, receiver, observer, overwrite=overwrite)
    if rerun is not None:
        from mapper.export.rerun.target import check_target

        refuse_existing(Path(check_target(rerun)), overwrite=overwrite, option="--rerun")
    if isinstance(config, Mapping):
        settings = {**flattened(config), **flattened(settings or {})}
        config = None
    if not isinstance(log, Log):
        log = _opened(log, config, settings)
    own = _own_odometry(odometry, log, receiver)
    wanted = {**_first_settings(own, out), **flattened(settings or {})}
    if isinstance(config, BuildConfig):
        resolved = overridden(config, settings=wanted)
    else:
        resolved = load_config(config, settings=wanted, sensor=log.sensor)
    note_compilation(receiver)
    for note in log.sentences:
        receiver.note(note)
    with _observers(log, resolved, out, rerun, observer, receiver) as watching:
        return build_run(
            log,
            resolved,
            out,
            odometry=own,
            progress=receiver,
            observer=watching,
            overwrite=overwrite,
            fresh=fresh,
        )


def _append(
    log: Log | AnyPath,
    onto: Run | AnyPath,
    out: Path,
    settings: Settings | None,
    progress: Progress,
    observer: Observer,
    *,
    overwrite: bool,
) -> Run:
    from mapper.pipeline.append import append

    first = onto if isinstance(onto, Run) else open_run(onto)
    config = overridden(first.config.model_copy(update={"source": SourceConfig()}), settings=settings)
    second = log if isinstance(log, Log) else open_source(Path(log), config.source)
    with _observers(second, config, out, None, observer, progress) as watching:
        return append(second, first, config, out, progress=progress, observer=watching, overwrite=overwrite)


@contextmanager
def _observers(
    log: Log, config: BuildConfig, out: Path, rerun: str | None, observer: Observer, progress: Progress
) -> Iterator[Observer]:
    """Yield the caller's observer, the picture of the build, and Rerun where it is wanted."""
    shown = partial_of(out) / PREVIEW
    preview = Preview(shown.resolve(), log, on_first=lambda: progress.note(f"first picture: {shown}"))
    if rerun is None:
        yield Observers(observer, preview)
        return
    from mapper.export.rerun.live import live_recording

    is_built = False
    try:
        with live_recording(rerun, log, config.rerun) as live:
            yield Observers(live, observer, preview)
            is_built = True
    except ViewerError as error:
        if not is_built:
            raise
        warnings.warn(str(error), MapperWarning, stacklevel=3)


def _opened(path: AnyPath, config: BuildConfig | AnyPath | None, settings: Settings | None) -> Log:
    if isinstance(config, BuildConfig):
        return open_log(path, settings={"source": config.source.model_dump(), **(settings or {})})
    return open_log(path, config=config, settings=settings)


def _own_odometry(
    odometry: OwnOdometry | None, log: Log, progress: Progress
) -> Odometry[Any] | Trajectory | None:
    if odometry is None or isinstance(odometry, Trajectory | Odometry):
        return odometry
    if callable(odometry):
        return poses_of(odometry, log, progress=progress)
    raise ConfigError(
        f"odometry: {type(odometry).__name__} is no odometry; want an object with read, track, view, "
        "matches and finish, a function that returns the pose of a frame, or a Trajectory"
    )


def _first_settings(own: Odometry[Any] | Trajectory | None, out: Path) -> dict[str, Any]:
    match own:
        case None:
            return {}
        case Trajectory():
            return {**_OWN_POSES, "odometry.path": out.resolve() / files.ODOMETRY}
        case _:
            return {"odometry.kind": "own", "odometry.name": type(own).__name__}
