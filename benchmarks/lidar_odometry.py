"""Odometry for scans on LiDAR logs with truth, compared with that of other projects in the same run.

    python benchmarks/lidar_odometry.py LOG… [--kinds gicp icp kiss-icp hough-ndt]

Peers are KISS-ICP, GenZ-ICP and, on logs with angular velocities and accelerations, RKO-LIO, each as its
authors' library runs it, on one thread; one that is not installed is left out. Times are CPU milliseconds per
scan, without reading; `ratio` is KISS-ICP's over the method's.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mapper.config.loading import load_config
from mapper.core.frames import Scan
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.evaluators.compare.catalogue import RkoLioTracker
from mapper.evaluators.compare.methods import OdometryTracker, Tracker
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.odometry.factory import build_frame_odometry
from mapper.sources import open_source
from mapper.sources.base import Log

_VOXEL_M = 1.0  # as both peers have for outdoor LiDARs


class PipelineTracker:
    """Tracker by a pipeline with ``register_frame`` and ``last_pose``."""

    def __init__(self, pipeline: Any) -> None:
        self._pipeline = pipeline
        self._poses: list[tuple[int, Any]] = []

    def add(self, scan: Scan) -> bool:
        """Register the next scan with the times of its points, if it has any."""
        times_s = np.empty(0) if scan.times_s is None else scan.times_s.astype(np.float64)
        self._pipeline.register_frame(scan.points_body.astype(np.float64), times_s)
        self._poses.append((scan.stamp_ns, np.array(self._pipeline.last_pose)))
        return True

    def trajectory(self) -> Trajectory:
        """Return a pose for each scan."""
        return trajectory_from(self._poses)


def ours(kind: str) -> Tracker:
    """Return one of our odometries, without loops."""
    config = load_config(None, [f"odometry.kind={kind}"], sensor="lidar")
    return OdometryTracker(build_frame_odometry(config.odometry))


def kiss_icp() -> Tracker:
    """Return KISS-ICP as its authors' pipeline runs it."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    settings = KISSConfig()
    settings.mapping.voxel_size = _VOXEL_M
    settings.registration.max_num_threads = 1
    return PipelineTracker(KissICP(settings))


def genz_icp() -> Tracker:
    """Return GenZ-ICP (Lee et al. 2025) as its authors' pipeline runs it."""
    from genz_icp.config import GenZConfig
    from genz_icp.genz_icp import GenZICP

    settings = GenZConfig()
    settings.mapping.voxel_size = _VOXEL_M
    return PipelineTracker(GenZICP(settings))


def peers_for(log: Log) -> Iterator[tuple[str, Callable[[], Tracker]]]:
    """Yield the installed peers that can use a log."""
    yield "KISS-ICP itself", kiss_icp
    if find_spec("genz_icp") is not None:
        yield "GenZ-ICP itself", genz_icp
    if find_spec("rko_lio") is not None and log.gyroscope is not None and log.accelerations is not None:
        yield "RKO-LIO itself", lambda: RkoLioTracker(log)


def measured(log: Log, tracker: Tracker) -> tuple[float, float, int, int]:
    """Return ATE in metres, CPU milliseconds a scan, scans placed and scans read."""
    if log.truth is None:
        raise SystemExit(f"{log.path}: has no truth to measure against")
    seconds, scans = 0.0, 0
    for entry in log.entries():
        scan = entry.scan()
        began = time.process_time()
        tracker.add(scan)
        seconds += time.process_time() - began
        scans += 1
    trajectory = tracker.trajectory()
    return ate_rmse_m(trajectory, log.truth), 1e3 * seconds / scans, len(trajectory), scans


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--kinds", nargs="+", default=["gicp", "icp", "kiss-icp", "hough-ndt"])
    arguments = parser.parse_args()
    print(f"{'log':<20} {'method':<16} {'ATE m':>8} {'placed':>10} {'ms':>7} {'ratio':>6}")
    for path in arguments.logs:
        log = open_source(path)
        measured(log, ours("gicp"))  # compiles the kernels
        rows = [(name, *measured(log, build())) for name, build in peers_for(log)]
        rows += [(kind, *measured(log, ours(kind))) for kind in arguments.kinds]
        for name, error_m, ms, placed, scans in rows:
            share = f"{placed}/{scans}"
            print(f"{path.name:<20} {name:<16} {error_m:8.4f} {share:>10} {ms:7.1f} {rows[0][2] / ms:6.2f}")


if __name__ == "__main__":
    main()
