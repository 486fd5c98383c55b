"""Map a log by an odometry of your own: a function from a frame to the body's pose.

The toolkit does the rest: keyframes, loops, the solve, levelling and the maps. The odometry here is a plain
one, for scans: each is registered to the one before it, with the last motion as the guess.

    python examples/own_odometry.py                       # a street that the toolkit simulates
    python examples/own_odometry.py LOG [OUT]             # your own log of scans
"""

import sys
from pathlib import Path

import numpy as np
from synthetic_logs import scratch, street_log

import mapper


class ScanToScan:
    """Odometry by point-to-plane ICP of consecutive scans; it drifts, as all do that keep no map."""

    def __init__(self) -> None:
        self.last = None
        self.T_world_body = np.eye(4)
        self.T_last_now = np.eye(4)

    def __call__(self, frame):
        """Return the (4, 4) pose of the body in the world where it began, or None where it is not known."""
        scan = frame.scan()
        if self.last is not None:
            found = mapper.register(scan, self.last, method="plane-icp", guess=self.T_last_now)
            if not found.converged:
                return None  # the next scan is tried against the same one
            self.T_last_now = found.T_target_source
            self.T_world_body = self.T_world_body @ found.T_target_source
        self.last = scan
        return self.T_world_body


def main(log: Path, out: Path) -> None:
    """Build the log by the odometry above, and by the toolkit's own."""
    own = mapper.build(log, out=out / "own", odometry=ScanToScan())
    ours = mapper.build(log, out=out / "toolkit")
    for name, run in (("own odometry", own), ("toolkit", ours)):
        error_m = mapper.evaluate(run).ate_m
        told = "no truth" if error_m is None else f"ATE {error_m:.3f} m"
        print(f"{name}: {len(run.trajectory)} poses, {run.trajectory.path_length_m:.1f} m, {told}")
    print(f"poses as given: {own.file('odometry.tum')}")


if __name__ == "__main__":
    folder = scratch()
    log = Path(sys.argv[1]) if len(sys.argv) > 1 else street_log(folder)
    main(log, Path(sys.argv[2]) if len(sys.argv) > 2 else folder)
