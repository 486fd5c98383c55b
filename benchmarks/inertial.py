"""Made logs with the readings of an IMU, tracked and solved with and without them.

Turns of 180°/s by hand, two scans or images a second, a tunnel of 50 m, 2 s with a covered lens or without
frames, stairs; and faults of the readings: another unit, a flipped axis, 50 ms of delay, a gyroscope that
saturates. "worse" marks what errs more than 1.05 times as much as without readings; NEES/6 is that of poses
relative to those 1 s before.

    python -m benchmarks.inertial --seeds 51 52 53
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from mapper.config.loading import load_config
from mapper.core.geometry import Array, fit_rigid
from mapper.core.timebase import NS_PER_S
from mapper.evaluators.metrics.consistency import window_nees
from mapper.evaluators.metrics.silent_failures import check_doubts
from mapper.pipeline.inertial_bridging import bridge
from mapper.pipeline.solve import solve
from mapper.pipeline.track import first_session, track_log
from mapper.pipeline.tracking_result import TrackingResult, from_tracking
from mapper.runtime.progress import SILENT
from mapper.simulation import CameraSimulator
from mapper.simulation.config import (
    LIDAR_SCENES,
    DisturbanceConfig,
    LidarSensorConfig,
    LidarSynthConfig,
    SynthConfig,
    SynthImuConfig,
)
from mapper.simulation.lidar import LidarSimulator
from mapper.sources.base import Log

_IMU = SynthImuConfig()
_SMALL = {"width_px": 320, "height_px": 240, "texture_px_per_m": 128, "imu": _IMU}
_RINGS = LidarSensorConfig(rings=16, lowest_ring_rad=-0.26, highest_ring_rad=0.26, azimuth_steps=450)
_BY_HAND = {
    "duration_s": 20.0, "speed_mps": 1.3, "mount_height_m": 1.3, "tilt_rad": 0.15, "yaw_swing_rad": 0.6,
    "imu": _IMU,
}  # fmt: skip
_NEAR = {"min_range_m": 0.5, "max_range_m": 70.0}
SCENES: Mapping[str, SynthConfig | LidarSynthConfig] = {
    "images, 180°/s, 5 Hz": SynthConfig(
        **_SMALL, frame_rate_hz=5.0, duration_s=20.0, max_yaw_rate_rad_s=3.14
    ),
    "images, 2 Hz": SynthConfig(**_SMALL, frame_rate_hz=2.0, duration_s=30.0),
    "images, lens covered 2 s": SynthConfig(
        **_SMALL, frame_rate_hz=10.0, duration_s=16.0, blackout_start_s=7.0, blackout_duration_s=2.0
    ),
    "images, dark 2 s": SynthConfig(
        **_SMALL,
        frame_rate_hz=10.0,
        duration_s=16.0,
        speed_mps=1.3,
        disturbances=DisturbanceConfig(gap_start_s=7.0, gap_duration_s=2.0),
    ),
    "scans, 180°/s, 2 Hz": LidarSynthConfig(
        scene="courtyard", loop_m=60.0, rate_hz=2.0, duration_s=30.0, speed_mps=1.2, tilt_rad=0.3,
        yaw_swing_rad=1.5, sensor=_RINGS, imu=_IMU,
    ),
    "scans, tunnel of 50 m": LIDAR_SCENES["tunnel"].model_copy(
        update={
            "loop_m": 100.0, "overlap_m": 0.0, "tilt_rad": 0.15, "yaw_swing_rad": 0.3, "speed_mps": 1.5,
            "rate_hz": 5.0, "sensor": _RINGS.model_copy(update={"max_range_m": 20.0}), "imu": _IMU,
        }
    ),
    "scans, stairs": LIDAR_SCENES["staircase"].model_copy(update={"duration_s": 40.0, "imu": _IMU}),
    "scans of a zigzag, yard": LidarSynthConfig(
        scene="courtyard", pedestrians=3, **_BY_HAND,
        sensor=LidarSensorConfig(
            pattern="zigzag", rings=4, azimuth_steps=5000, lowest_ring_rad=-0.12, highest_ring_rad=0.9,
            **_NEAR,
        ),
    ),
    "scans of a rosette, rooms": LidarSynthConfig(
        scene="flat", **_BY_HAND,
        sensor=LidarSensorConfig(pattern="rosette", rings=6, azimuth_steps=4000, **_NEAR),
    ),
}  # fmt: skip


def _degrees(log: Log) -> Log:
    return _changed(log, np.degrees)


def _flipped(log: Log) -> Log:
    return _changed(log, lambda rates: rates * [1.0, -1.0, 1.0])


def _late(log: Log) -> Log:
    assert log.gyroscope is not None
    assert log.accelerations is not None
    shift = {"stamps_ns": log.gyroscope.stamps_ns + 50_000_000}
    return replace(
        log, gyroscope=replace(log.gyroscope, **shift), accelerations=replace(log.accelerations, **shift)
    )


def _saturated(log: Log) -> Log:
    return _changed(log, lambda rates: np.clip(rates, -1.2, 1.2))


def _changed(log: Log, change: Callable[[Array], Array]) -> Log:
    assert log.gyroscope is not None
    changed = replace(log.gyroscope, rates_radps=change(log.gyroscope.rates_radps))
    sound, _ = changed.without_faults()
    return replace(log, gyroscope=sound)


FAULTS = {"degrees": _degrees, "flipped axis": _flipped, "50 ms late": _late, "saturated": _saturated}


def made(config: SynthConfig | LidarSynthConfig) -> Log:
    """Return the log of a configuration."""
    return (CameraSimulator(config) if isinstance(config, SynthConfig) else LidarSimulator(config)).log()


def mapped(log: Log) -> TrackingResult:
    """Return the result of tracking a log and solving its graph, as a build does without maps."""
    config = load_config(sensor=log.sensor)
    tracking = track_log(log, config, progress=SILENT, start=first_session(log, config))
    tracking = bridge(log, tracking, progress=SILENT)
    solved = solve(tracking.graph, tracking.loops, config.graph)
    return replace(tracking, graph=solved.graph, loops=solved.loops)


def row(name: str, log: Log, tracking: TrackingResult, best_m: float) -> tuple[str, float]:
    """Return a row of the table, and the ATE of the frames without a doubt, metres."""
    assert log.truth is not None
    trajectory = tracking.tracked_trajectory()
    stored = from_tracking(tracking, log)
    true = log.truth.positions_world[np.searchsorted(log.truth.stamps_ns, trajectory.stamps_ns)]
    T, _ = fit_rigid(true, trajectory.positions_world)
    off_m = np.linalg.norm(trajectory.positions_world @ T[:3, :3].T + T[:3, 3] - true, axis=1)
    ate_m = float(np.sqrt(np.mean(off_m**2)))
    check = check_doubts(stored.trajectory, stored.records, log.truth)
    nees = window_nees(
        tracking.trajectory(), tracking.graph, stored.records, log.truth, window_ns=NS_PER_S
    ).mean
    lost = len(tracking.tracks) - len(tracking.placed)
    doubtful = len(tracking.placed) - len(tracking.tracked)
    flag = "" if not best_m or ate_m <= 1.05 * best_m else " worse"
    text = (
        f"{name:44} {ate_m:8.4f} m {off_m.max():7.3f} m, {lost:3} lost {doubtful:3} doubtful of "
        f"{len(tracking.tracks):3}, {check.silent} silent, NEES/6 {nees:.2f}{flag}"
    )
    return text, ate_m


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[51, 52, 53])
    parser.add_argument("--scenes", nargs="+", default=[*SCENES])
    parser.add_argument("--faults", action="store_true", help="the faults as well, of the first seed")
    arguments = parser.parse_args()
    for name in arguments.scenes:
        for seed in arguments.seeds:
            log = made(SCENES[name].model_copy(update={"seed": seed}))
            without = mapped(replace(log, gyroscope=None, accelerations=None))
            text, best_m = row(f"{name}, seed {seed}, without", log, without, 0.0)
            print(text, flush=True)
            print(row(f"{name}, seed {seed}, with", log, mapped(log), best_m)[0], flush=True)
            if not arguments.faults or seed != arguments.seeds[0]:
                continue
            for fault, change in FAULTS.items():
                faulty = mapped(change(log))
                print(row(f"{name}, seed {seed}, {fault}", log, faulty, best_m)[0])
                for warning in faulty.warnings:
                    print(f"    {warning.kind}: {warning.sentence}", flush=True)


if __name__ == "__main__":
    main()
