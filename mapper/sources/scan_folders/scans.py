"""The scans of LiDAR logs that are made of cloud files."""

from dataclasses import dataclass
from pathlib import Path

from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.timebase import NS_PER_S
from mapper.sources.base import EntryWithoutFiles
from mapper.sources.cloud_files import read_cloud
from mapper.sources.cloud_files.parsing import MIN_POINTS
from mapper.sources.point_times import relative_times_s, without_untimed
from mapper.sources.valid_returns import FARTHEST_M, valid_returns


@dataclass(frozen=True, slots=True)
class ScanEntry(EntryWithoutFiles):
    """Cloud file, not read yet; the body is the LiDAR."""

    stamp_ns: int
    path: Path
    scale: float | None = None
    """Metres per unit of the file; None is 1, and checked."""
    bin_columns: int | None = None
    """Numbers of a record in a .bin file; None is KITTI's four, and checked."""
    rows: tuple[int, int] | None = None
    """First point of a LAS file, and the one after the last; None is the whole file."""

    def load(self, *, colour: bool = True) -> Scan:
        """Read the cloud, with the time of each point where the file has it; far returns are left out.

        Raises:
            FrameError: The file is missing, damaged, empty or not in metres around the sensor.
        """
        cloud = read_cloud(self.path, scale=self.scale, bin_columns=self.bin_columns, rows=self.rows)
        points_body, rows, far = valid_returns(cloud.points)
        if len(points_body) < max(MIN_POINTS, far):
            raise FrameError(
                f"{self.path}: {far} of {len(cloud.points)} points are farther than {FARTHEST_M:g} m, which "
                "no sensor reaches"
            )
        kept = slice(None) if rows is None else rows
        times = None if cloud.times is None else cloud.times[kept]
        if times is not None and self.rows is not None:  # on the clock of the stamp, which may begin with 0
            times = times - self.stamp_ns / NS_PER_S
        scan = Scan(
            stamp_ns=self.stamp_ns,
            points_body=points_body,
            colors=cloud.colors[kept] if colour and cloud.colors is not None else None,
            times_s=None if times is None else relative_times_s(times, self.stamp_ns),
            far_returns=far,
            intensities=cloud.intensities[kept] if colour and cloud.intensities is not None else None,
        )
        return without_untimed(scan)

    def scan(self) -> Scan:
        """Read the cloud without colours and intensities.

        Raises:
            FrameError: As ``load``.
        """
        return self.load(colour=False)
