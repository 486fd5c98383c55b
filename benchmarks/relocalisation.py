"""Relocalisation after fast rotation and a covered lens: twelve similar logs, both keyframe odometries.

    python benchmarks/relocalisation.py [--settings 12] [--set loops.kind=none]

In each log the camera turns on the spot at 1.7 to 2.1 rad/s for 12 s, with motion blur, 5 to 10 % of the
frames missing and 1 to 2 s of darkness after the first turn. "frames" counts the frames from the first after
the darkness that shows a known place (within 0.3 m and 20 degrees of an earlier true pose) to the first that
is placed; 0 is that frame itself. "lost" excludes the dark frames. ATE RMSE of the solved graph after SE(3)
alignment.
"""

import argparse
from dataclasses import dataclass, replace

import cv2
import numpy as np

from mapper.config.loading import load_config
from mapper.core.geometry import angle_between
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory import align, associate, ate
from mapper.pipeline.solve import solve
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.simulation.config import SensorConfig, SynthConfig
from mapper.simulation.path import START_NS
from mapper.simulation.source import CameraSimulator, SyntheticEntry
from mapper.sources.base import Log

KINDS = ("local-map", "pnp")
SEEDS = 4
NEAR_M, NEAR_RAD = 0.3, np.radians(20.0)


def rendered(config: SynthConfig) -> Log:
    """Return a synthetic log that is rendered once and tracked often, in grey, which is enough to track."""
    log = CameraSimulator(config).log()
    frames = [entry.load(colour=False) for entry in log.entries()]
    return replace(
        log, entry_at=lambda index: SyntheticEntry(frames[index].stamp_ns, lambda _colour: frames[index])
    )


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one odometry on one log."""

    frames: int | None
    lost: int
    ate_mm: float


def setting(k: int) -> SynthConfig:
    """Return the k-th log: four flats, each at three speeds."""
    pace = k // SEEDS % 3
    return SynthConfig(
        seed=k % SEEDS,
        path="spin",
        duration_s=12.0,
        width_px=320,
        height_px=240,
        texture_px_per_m=128,
        max_yaw_rate_rad_s=(1.7, 1.9, 2.1)[pace],
        drop_ratio=(0.05, 0.1, 0.1)[pace],
        blackout_start_s=(6.0, 5.5, 6.5)[pace],
        blackout_duration_s=(1.0, 1.5, 2.0)[pace],
        sensor=SensorConfig(exposure_s=(0.006, 0.008, 0.01)[pace]),
    )


def judged(log: Log, flat: SynthConfig, overrides: list[str]) -> Outcome:
    """Track and solve a log, and compare with what was there to be found."""
    config = load_config(None, overrides)
    truth = log.truth
    assert truth is not None
    tracking = track_log(log, config, progress=SILENT)
    solved = solve(tracking.graph, tracking.loops, config.graph)
    matched = associate(replace(tracking, graph=solved.graph).trajectory(), truth)
    rmse_m = ate(align(matched, "se3").moved(matched)).rmse

    placed = {track.stamp_ns for track in tracking.placed}
    start_ns = START_NS + round(flat.blackout_start_s * NS_PER_S)
    end_ns = start_ns + round(flat.blackout_duration_s * NS_PER_S)
    lit = [stamp_ns for stamp_ns in log.stamps_ns.tolist() if not start_ns <= stamp_ns < end_ns]
    after = [stamp for stamp in lit if stamp >= end_ns]
    known = [i for i, stamp in enumerate(after) if seen_before(truth, stamp, until_ns=start_ns)]
    found = [i for i, stamp in enumerate(after) if stamp in placed and i >= known[0]] if known else []
    return Outcome(
        frames=found[0] - known[0] if found else None,
        lost=sum(stamp not in placed for stamp in lit),
        ate_mm=1e3 * rmse_m,
    )


def seen_before(truth: Trajectory, stamp_ns: int, *, until_ns: int) -> bool:
    """Return whether a frame before ``until_ns`` was truly taken from near a frame's pose."""
    T_world_now = truth.T_world_body[truth.stamps_ns == stamp_ns][0]
    return any(
        np.linalg.norm(T[:3, 3] - T_world_now[:3, 3]) < NEAR_M
        and angle_between(T[:3, :3], T_world_now[:3, :3]) < NEAR_RAD
        for T in truth.T_world_body[truth.stamps_ns < until_ns]
    )


def main() -> None:
    """Print one row per log, and the spread of each odometry."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--settings", type=int, default=12, help="how many of the logs")
    parser.add_argument("--set", dest="overrides", action="append", default=[], help="key.path=value")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    outcomes: dict[str, list[Outcome]] = {kind: [] for kind in KINDS}
    print("seed  rad/s  dark  " + "".join(f"{kind:>10}: frames  lost  ATE mm" for kind in KINDS))
    for k in range(arguments.settings):
        config = setting(k)
        log = rendered(config)
        row = f"{config.seed:4d}  {config.max_yaw_rate_rad_s:5.1f}  {config.blackout_duration_s:3.1f}s  "
        for kind in KINDS:
            outcome = judged(log, config, [*arguments.overrides, f"odometry.kind={kind}"])
            outcomes[kind].append(outcome)
            frames = "never" if outcome.frames is None else outcome.frames
            row += f"{frames:>18} {outcome.lost:>5} {outcome.ate_mm:>7.1f}"
        print(row, flush=True)
    for kind, every in outcomes.items():
        errors_mm = [outcome.ate_mm for outcome in every]
        median_mm, worst_mm = float(np.median(errors_mm)), max(errors_mm)
        late = sum(outcome.frames is None or outcome.frames > 15 for outcome in every)
        print(
            f"{kind}: ATE median {median_mm:.1f} mm, worst {worst_mm:.1f} mm: {worst_mm / median_mm:.2f} "
            f"times the median; found after more than 15 frames: {late} of {len(every)}"
        )


if __name__ == "__main__":
    main()
