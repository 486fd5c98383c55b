"""Compare methods of registration on two clouds of your own: who finds the motion, how well, how fast?

python examples/compare_registrations.py              # two scans of a street that the toolkit simulates
python examples/compare_registrations.py SOURCE TARGET     # files, or LOG@N for the n-th frame of a log
"""

import sys
import time

import numpy as np
from synthetic_logs import scratch, street_log

import mapper

METHODS = ("icp", "plane-icp", "gicp", "hough-gicp")


def main(source: str, target: str) -> None:
    """Register the two by every method, and print a row for each."""
    print(f"{'method':<12} {'trusted':<8} {'x':>8} {'y':>8} {'z':>8} {'yaw °':>8} {'RMS m':>8} {'s':>6}")
    for method in METHODS:
        mapper.register(source, target, method=method)  # loads and compiles what it needs
        began = time.perf_counter()
        found = mapper.register(source, target, method=method)
        seconds = time.perf_counter() - began
        T = found.T_target_source
        yaw = np.degrees(np.arctan2(T[1, 0], T[0, 0]))
        numbers = " ".join(f"{value:8.3f}" for value in (*T[:3, 3], yaw, found.inlier_rmse_m))
        print(f"{method:<12} {'yes' if found.converged else 'no':<8} {numbers} {seconds:6.2f}")
        if not found.converged:
            print(f"{'':<12} {found.reason}")


if __name__ == "__main__":
    if len(sys.argv) == 3:
        main(sys.argv[1], sys.argv[2])
    else:
        street = street_log(scratch())
        main(f"{street}@3", f"{street}@0")
