"""Consistency of covariances: NEES/6 of relative poses against the truth; 1 is consistent.

    python benchmarks/uncertainty.py LOG… [--set key=value]

Each log with truth is tracked, searched for loops and solved. Printed per log: NEES/6, mean and median, of
the poses of tracked frames relative to those 1 s before and to the ones before them, of odometry factors and
of loops. The truth is
interpolated; its noise and clock errors count as ours: at 0.3 m/s a clock error of 5 ms is 1.5 mm.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from mapper.config.loading import load_config, load_source_config
from mapper.core.timebase import NS_PER_S
from mapper.evaluators.metrics.consistency import Nees, factor_nees, window_nees
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.pipeline.disconnected_components import largest_component
from mapper.pipeline.solve import solve
from mapper.pipeline.track import track_log
from mapper.run.frame_records import records_of
from mapper.runtime.progress import SILENT
from mapper.sources import open_source


def main() -> None:
    """Print a row per log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args()
    print(f"{'log':24} {'ATE m':>8} {'1 s windows':>18} {'steps':>18} {'odometry factors':>18} {'loops':>18}")
    for path in arguments.logs:
        log = open_source(path, load_source_config(None, arguments.set))
        if log.truth is None:
            raise SystemExit(f"{path}: no truth")
        config = load_config(None, arguments.set, sensor=log.sensor)
        tracking = largest_component(track_log(log, config, progress=SILENT), progress=SILENT)
        solved = solve(tracking.graph, tracking.loops, config.graph)
        factors = {
            origin: factor_nees(
                [factor for factor in solved.graph.factors if factor.origin == origin],
                solved.graph,
                log.truth,
            )
            for origin in ("odometry", "loop")
        }
        tracking = replace(tracking, graph=solved.graph, loops=solved.loops)
        records = records_of(tracking.tracks, tracking.skipped)
        trajectory = tracking.trajectory()
        windows, steps = (
            window_nees(trajectory, solved.graph, records, log.truth, window_ns=window_ns)
            for window_ns in (NS_PER_S, 1)
        )
        error_m = ate_rmse_m(trajectory, log.truth)
        print(
            f"{path.name:24} {error_m:8.4f} {_text(windows)} {_text(steps)} "
            f"{_text(factors['odometry'])} "
            f"{_text(factors['loop'])}",
            flush=True,
        )


def _text(nees: Nees) -> str:
    return f"{nees.mean:5.2f} {nees.median:5.2f} ({nees.count:4d})"


if __name__ == "__main__":
    main()
