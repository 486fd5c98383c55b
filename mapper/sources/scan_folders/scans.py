"""The scans of LiDAR logs that are made of cloud files."""

from pathlib import Path

from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.timebase import NS_PER_S
from mapper.sources.cloud_files import read_cloud
from mapper.sources.cloud_files.parsing import MIN_POINTS
from mapper.sources.point_times import field_times_s, time_field, without_untimed
from mapper.sources.valid_returns import FARTHEST_M, valid_returns


def read_scan(
    path: Path,
    stamp_ns: int = 0,
    *,
    colour: bool = True,
    scale: float | None = None,
    bin_columns: int | None = None,
    rows: tuple[int, int] | None = None,
) -> Scan:
    """Return a cloud file as a scan, with the time of each point where it has it; far returns are left out.

    Args:
        path: A file of one of ``cloud_files.ENDINGS``.
        stamp_ns: Time of the scan.
        colour: False leaves colours and intensities out.
        scale: Metres per unit of the file; None is 1, and refuses what looks like millimetres.
        bin_columns: Numbers of a record in a .bin file; None is KITTI's four, and refuses others.
        rows: First point of a LAS file, and the one after the last; None is the whole file.

    Raises:
        FrameError: The file is missing, damaged, empty or not in metres around the sensor.
    """
    cloud = read_cloud(path, scale=scale, bin_columns=bin_columns, rows=rows)
    points_body, valid, far = valid_returns(cloud.points)
    if len(points_body) < max(MIN_POINTS, far):
        raise FrameError(
            f"{path}: {far} of {len(cloud.points)} points are farther than {FARTHEST_M:g} m, which "
            "no sensor reaches"
        )
    kept = slice(None) if valid is None else valid
    name, times = time_field(cloud.names) or "", None if cloud.times is None else cloud.times[kept]
    if times is not None and rows is not None:  # on the clock of the stamp, which may begin with 0
        times = times - stamp_ns / NS_PER_S
    scan = Scan(
        stamp_ns=stamp_ns,
        points_body=points_body,
        colors=cloud.colors[kept] if colour and cloud.colors is not None else None,
        times_s=None if times is None else field_times_s(name, times, stamp_ns),
        far_returns=far,
        intensities=cloud.intensities[kept] if colour and cloud.intensities is not None else None,
    )
    return without_untimed(scan)
