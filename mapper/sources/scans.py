"""The scans of LiDAR logs that are made of cloud files."""

from dataclasses import dataclass
from pathlib import Path

from mapper.core.frames import Scan
from mapper.sources.base import ImageFiles
from mapper.sources.cloud_files import read_cloud
from mapper.sources.point_times import relative_times_s


@dataclass(frozen=True, slots=True)
class ScanEntry:
    """Cloud file, not read yet; the body is the LiDAR."""

    stamp_ns: int
    path: Path
    scale: float | None = None
    """Metres per unit of the file; None is 1, and checked."""
    files: ImageFiles | None = None

    def load(self, *, colour: bool = True) -> Scan:
        """Read the cloud, with the time of each point where the file has it.

        Raises:
            FrameError: The file is missing, damaged, empty or not in metres around the sensor.
        """
        cloud = read_cloud(self.path, scale=self.scale)
        return Scan(
            stamp_ns=self.stamp_ns,
            points_body=cloud.points,
            colors=cloud.colors if colour else None,
            times_s=None if cloud.times is None else relative_times_s(cloud.times, self.stamp_ns),
        )

    def scan(self) -> Scan:
        """Read the cloud.

        Raises:
            FrameError: As ``load``.
        """
        return self.load()
