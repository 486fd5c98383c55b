"""What LiDAR logs made of cloud files share: the scans themselves, and the log of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapper.core.frames import Scan, Sensor
from mapper.core.trajectory import Trajectory
from mapper.sources.base import Accelerations, FrameRef, ImageFiles
from mapper.sources.cloud_files import read_cloud
from mapper.sources.point_times import relative_times_s


@dataclass(frozen=True, slots=True)
class ScanEntry:
    """One cloud on disk; the body is the LiDAR."""

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


@dataclass(slots=True, eq=False)
class ScanLog:
    """A log whose frames are cloud files; see :class:`mapper.sources.base.FrameSource`."""

    path: Path
    name: str
    kind: str
    truth: Trajectory | None
    notes: Sequence[str]
    scans: Sequence[ScanEntry]
    sensor: Sensor = "lidar"
    accelerations: Accelerations | None = None
    wheels: Trajectory | None = None

    def __len__(self) -> int:
        return len(self.scans)

    def entries(self) -> Iterator[FrameRef]:
        """Yield every scan's entry in time order."""
        yield from self.scans
