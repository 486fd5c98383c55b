"""Odometry for scans on LiDAR logs with truth, compared with KISS-ICP's own pipeline in the same run.

    python benchmarks/lidar_odometry.py LOG… [--kinds gicp icp kiss-icp hough-ndt]

Times are CPU milliseconds per scan in one thread, without reading; `ratio` is the peer's time over ours.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mapper.config.loading import load_config
from mapper.core.frames import Scan
from mapper.core.geometry import Transform
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory import ate_rmse_m
from mapper.odometry.factory import build_frame_odometry
from mapper.sources import open_source

Follow = Callable[[Scan], Transform | None]


def ours(kind: str) -> Follow:
    """Return one of our odometries, without loops."""
    odometry = build_frame_odometry(load_config(None, [f"odometry.kind={kind}"], sensor="lidar").odometry)

    def follow(scan: Scan) -> Transform | None:
        track = odometry.track(odometry.observe(scan))
        return None if track.node is None else track.T_world_body

    return follow


def peer() -> Follow:
    """Return KISS-ICP as its authors' pipeline runs it, on one thread."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    settings = KISSConfig()
    settings.mapping.voxel_size = 1.0
    settings.registration.max_num_threads = 1
    pipeline = KissICP(settings)

    def follow(scan: Scan) -> Transform | None:
        times_s = np.empty(0) if scan.times_s is None else scan.times_s.astype(np.float64)
        pipeline.register_frame(scan.points_body.astype(np.float64), times_s)
        pose: Transform = pipeline.last_pose
        return pose

    return follow


def measured(log: Path, follow: Follow) -> tuple[float, float, int, int]:
    """Return ATE in metres, CPU milliseconds a scan, scans placed and scans read."""
    source = open_source(log)
    stamps_ns, poses, seconds, scans = [], [], 0.0, 0
    for entry in source.entries():
        scan = entry.scan()
        began = time.process_time()
        T_world_body = follow(scan)
        seconds += time.process_time() - began
        scans += 1
        if T_world_body is not None:
            stamps_ns.append(entry.stamp_ns)
            poses.append(T_world_body)
    if source.truth is None:
        raise SystemExit(f"{log}: has no truth to measure against")
    error_m = ate_rmse_m(Trajectory(np.array(stamps_ns), np.array(poses)), source.truth)
    return error_m, 1e3 * seconds / scans, len(poses), scans


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--kinds", nargs="+", default=["gicp", "icp", "kiss-icp", "hough-ndt"])
    arguments = parser.parse_args()
    print(f"{'log':<20} {'method':<16} {'ATE m':>8} {'placed':>10} {'ms':>7} {'ratio':>6}")
    for log in arguments.logs:
        measured(log, ours("gicp"))  # compiles the kernels
        rows = [("KISS-ICP itself", *measured(log, peer()))]
        rows += [(kind, *measured(log, ours(kind))) for kind in arguments.kinds]
        for name, error_m, ms, placed, scans in rows:
            share = f"{placed}/{scans}"
            print(f"{log.name:<20} {name:<16} {error_m:8.4f} {share:>10} {ms:7.1f} {rows[0][2] / ms:6.2f}")


if __name__ == "__main__":
    main()
