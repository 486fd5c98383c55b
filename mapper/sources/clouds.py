"""Single clouds, and folders of them."""

from pathlib import Path

from mapper.frames import Scan
from mapper.sources.scans import ScanEntry


def read_scan(path: Path, *, scale: float | None = None) -> Scan:
    """Return the cloud of one file as a scan at time zero.

    Args:
        path: A file of one of ``cloud_files.ENDINGS``.
        scale: Metres per unit of the file; None is 1, and refuses what looks like millimetres.

    Raises:
        FrameError: The file is missing, damaged, empty or not in metres around the sensor.
    """
    return ScanEntry(0, path, scale).load()
