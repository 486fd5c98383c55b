"""LiDAR logs written as KITTI odometry folders: ``velodyne``, ``times.txt`` and ``poses.txt``."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import Scan
from mapper.core.timebase import MAX_TRUTH_GAP_NS, Stamps, nearest, seconds_text_from_ns
from mapper.core.trajectory import Trajectory
from mapper.runtime.atomic import write_text
from mapper.sources.base import Log, Skipped
from mapper.sources.readings_beside import write_readings
from mapper.sources.trajectory_files import write_kitti

_TIMED = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<f4")])


def write_kitti_log(
    source: Log, out: Path, *, on_progress: Callable[[int], None] | None = None
) -> list[Skipped]:
    """Write a LiDAR log as a KITTI folder and return the scans that could not be.

    There is no ``calib.txt``: poses are the LiDAR's own. They are written if every scan has a true one
    within 20 ms, for KITTI's lines bear no stamps. Colours are not kept.

    Args:
        source: Log that is written.
        out: Folder to make.
        on_progress: Receives the number of scans done, after each.

    Raises:
        SourceError: No frame of the source is a readable scan.
    """
    stamps_ns: list[int] = []
    skipped: list[Skipped] = []
    clouds = out / "velodyne"
    for done, entry in enumerate(source.entries(), start=1):
        try:
            scan = entry.load()
            if not isinstance(scan, Scan):
                raise SourceError(f"{source.path}: images, not scans; KITTI folders hold scans: --as tum")
            clouds.mkdir(parents=True, exist_ok=True)
            save_scan(clouds / f"{len(stamps_ns):06d}", scan)
            stamps_ns.append(scan.stamp_ns)
        except FrameError as error:
            skipped.append(Skipped(entry.stamp_ns, str(error)))
        if on_progress is not None:
            on_progress(done)
    if not stamps_ns:
        reason = skipped[0].reason if skipped else "it has no frames"
        raise SourceError(f"{source.path}: no frame can be written: {reason}")
    truth = source.truth and _at(source.truth, np.array(stamps_ns, dtype=np.int64))
    if truth is not None:
        write_kitti(out / "poses.txt", truth)
    write_readings(source, out)
    write_text(out / "times.txt", "".join(f"{seconds_text_from_ns(stamp_ns)}\n" for stamp_ns in stamps_ns))
    return skipped


def save_scan(stem: Path, scan: Scan) -> None:
    """Write a scan as KITTI's records, or x, y, z and t as an array where it has times.

    Where a scan has no intensities, those of the records are 0.
    """
    if scan.times_s is None:
        records = np.zeros((len(scan.points_body), 4), dtype="<f4")
        records[:, :3] = scan.points_body
        if scan.intensities is not None:
            records[:, 3] = scan.intensities
        records.tofile(stem.with_suffix(".bin"))
        return
    kind = _TIMED if scan.intensities is None else np.dtype([*_TIMED.descr, ("intensity", "<f4")])
    timed = np.empty(len(scan.points_body), dtype=kind)
    timed["x"], timed["y"], timed["z"] = scan.points_body.T
    timed["t"] = scan.times_s
    if scan.intensities is not None:
        timed["intensity"] = scan.intensities
    np.save(stem.with_suffix(".npy"), timed)


def _at(truth: Trajectory, stamps_ns: Stamps) -> Trajectory | None:
    """Return the nearest true pose of every stamp; None where one is too far."""
    index, gap_ns = nearest(truth.stamps_ns, stamps_ns)
    if gap_ns.max() > MAX_TRUTH_GAP_NS:
        return None
    return Trajectory(stamps_ns, truth.T_world_body[index])
