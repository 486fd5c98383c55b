"""Recorded logs as sequences of frames."""

from pathlib import Path

from mapper.core.errors import SourceError
from mapper.sources import clouds, kitti, mbag, numbered, poznan, tum
from mapper.sources.base import FrameSource
from mapper.sources.config import SourceConfig
from mapper.sources.ros import files as recordings
from mapper.sources.selection import select
from mapper.sources.wheel_files import read_wheels

__all__ = ["open_source"]

# The first that recognises a path opens it. Poznań's images are numbered too, so it is asked before;
# any log may have clouds lying about, so they are asked last.
_FORMATS = (tum, mbag, poznan, numbered, kitti, recordings, clouds)
_DEFAULTS = SourceConfig()


def open_source(path: Path, config: SourceConfig = _DEFAULTS) -> FrameSource:
    """Return a recorded log, recognised by its files, with the configured selection of its frames.

    Args:
        path: Folder of a TUM, Poznań, 7-Scenes, Redwood or KITTI log or of clouds, an mbag file or its
            folder, an MCAP file, or a ROS bag.
        config: Selection, pairing, camera, and what a folder of clouds does not tell by itself.

    Raises:
        SourceError: Nothing is there, no format fits, the log is malformed or nothing of it is selected.
    """
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    for log_format in _FORMATS:
        if log_format.recognise(path):
            log: FrameSource = log_format.open_log(path, config)
            if log.wheels is None and path.is_dir():
                log.wheels, notes = read_wheels(path, config.wheels, sensor=log.sensor)
                log.notes = [*log.notes, *notes]
            return select(log, config)
    looked_for = "; ".join(log_format.LOOKED_FOR for log_format in _FORMATS)
    raise SourceError(f"{path}: not a log of a known format; looked for {looked_for}")
