"""Recorded logs, and single frames, by name."""

from pathlib import Path
from typing import TYPE_CHECKING

from mapper.api.progress import AnyProgress, receiver_of
from mapper.config.loading import Settings, load_config, load_source_config
from mapper.core.errors import SourceError
from mapper.core.frames import Frame, Sensor
from mapper.runtime.regular_files import AnyPath
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.scan_folders.scans import read_scan

if TYPE_CHECKING:
    from mapper.sources.inspection import Inspection
    from mapper.sources.time_offsets import TimeOffset


def open_log(path: AnyPath, *, config: AnyPath | None = None, settings: Settings | None = None) -> Log:
    """Open a recorded log, recognised by its files; no frame is read yet.

    Iterating reads and decodes one frame at a time: :class:`~mapper.core.frames.RgbdFrame` or
    :class:`~mapper.core.frames.Scan`. ``log[10]`` is one frame, ``log[:20]`` the log of the first twenty.

    Args:
        path: A TUM, ICL-NUIM, Poznań, 7-Scenes, Redwood or KITTI folder, a folder of clouds, an MCAP file, a
            ROS bag, or an mbag file.
        config: TOML file, or a run's ``config.json``, whose ``source`` settings hold.
        settings: Values by dotted name, such as ``{"source.last_frame": 100}``.

    Returns:
        The log, with ``stamps_ns``, ``sensor`` ("rgbd", "lidar" or "lidar-2d"),
        and ``truth`` and ``wheels`` where known.

    Raises:
        SourceError: The path does not exist, no format fits, or the log is malformed.
        ConfigError: A setting is unknown or has no such value.

    Example:
        >>> log = mapper.open_log(log_folder)
        >>> len(log), log.sensor
        (31, 'rgbd')
        >>> for frame in log[:2]:
        ...     print(frame.image.shape, frame.scan().points.shape[1])
        (240, 320, 3) 3
        (240, 320, 3) 3
    """
    return open_source(Path(path), load_source_config(config, settings=settings))


def inspect(
    path: AnyPath,
    *,
    settings: Settings | None = None,
    time_offset: bool = False,
    progress: AnyProgress = None,
) -> "Inspection":
    """Return what is in a log, as ``mapper inspect`` shows it: topics, rates, gaps, calibration, truth.

    Args:
        path: As of :func:`open_log`.
        settings: Values by dotted name.
        time_offset: Measure how late the stamps of depth, gyroscope, wheels and truth are, too: the log is
            tracked for that.
        progress: Receives the stage of tracking: a function of lines, such as ``print``; None is silence.

    Returns:
        The findings; their ``problem`` says why nothing can be mapped, or is None.

    Raises:
        ConfigError: A setting is unknown or has no such value.
    """
    from mapper.sources.inspection import inspect_log  # loads foxglove, which opening a log may not need

    def refused(log: Log) -> str | None:
        from mapper.pipeline.track import why_untrackable

        return why_untrackable(log, load_config(settings=settings, sensor=log.sensor))

    def offsets(log: Log) -> "list[TimeOffset]":
        from mapper.pipeline.time_offsets import measure_time_offsets

        tracked_by = load_config(settings={**(settings or {}), "loops.kind": "none"}, sensor=log.sensor)
        return measure_time_offsets(log, tracked_by, progress=receiver_of(progress))

    config = load_source_config(settings=settings)
    return inspect_log(Path(path), config, check=refused, time_offsets=offsets if time_offset else None)


def read_frame(name: AnyPath, config: SourceConfig) -> tuple[Frame, Sensor]:
    """Return the frame of a name, and its sensor: a cloud's file counts as a LiDAR's, with z up.

    Args:
        name: A cloud, or ``LOG@N``: the n-th frame of a log, from 0.
        config: Settings by which logs are opened.

    Raises:
        SourceError: It is a folder, or the log has no such frame.
        FrameError: The frame or the cloud cannot be read.
    """
    path, name = Path(name), str(name)
    log, at, index = name.rpartition("@")
    if not at or path.exists():
        if path.is_dir():
            raise SourceError(
                f"{name}: is a folder; name a log's frame, as in {name}@0, "
                f"or a run's cloud, as in {name}/cloud.ply"
            )
        return read_scan(path, scale=config.cloud_scale, bin_columns=config.bin_columns), "lidar"
    opened = open_source(Path(log), config)
    if not index.isdecimal() or int(index) >= len(opened):
        raise SourceError(f"{name}: want a frame of {log} from @0 to @{len(opened) - 1}")
    return opened.entry_at(int(index)).load(), opened.sensor
