"""Measure ``mapper localise``: logs of another day in maps of the same place, in other places, kidnapped.

Synthetic flats (RGB-D) and streets (LiDAR) are made with ``mapper synth`` twice, the second time on another
day: other light, loose furniture and parked cars moved or gone, another path. Each second log is
localised in the map of the first, and in the map of the next seed, which has to be refused. Two pieces of it
joined together simulate a sensor that was carried away. Given logs are split in halves.

The truth is aligned to the map's frame by the rigid motion that fits the map's own trajectory to its truth
best, so bends of the map count as errors; the error relative to the nearest frame of the map, which excludes
them, is printed as well. NEES is of the latter, per degree of freedom: 1 if covariances are consistent.

    python benchmarks/localise.py OUT [--seeds 31 32 33] [--log LOG ...]
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper.config.build import BuildConfig
from mapper.config.loading import load_config, load_source_config
from mapper.core.errors import MapperError
from mapper.core.geometry import fit_rigid, inverse
from mapper.core.timebase import MAX_TRUTH_GAP_NS, nearest
from mapper.pipeline.build import build
from mapper.pipeline.known_map import load_known_map
from mapper.pipeline.localise import localise
from mapper.run import files
from mapper.run.folder import Run, open_run
from mapper.run.frame_records import read_records
from mapper.run.pose_covariances import read_poses
from mapper.simulation import write_tum_log
from mapper.simulation.config import LIDAR_SCENES, SynthConfig
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import chained

_WRONG_M = {"rgbd": 0.3, "lidar": 1.0}
_HEAD = (
    f"{'log':<22}{'in the map of':<22}{'placed':>8}{'wrong':>7}{'median':>9}{'RMSE':>9}{'to map frame':>13}"
    f"{'NEES':>7}{'cpu':>8}{'build cpu':>11}  verdict"
)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="folder of logs, runs and results; what is there is used")
    parser.add_argument("--seeds", type=int, nargs="*", default=[31, 32, 33])
    parser.add_argument("--scenes", nargs="*", default=["flat", "street"])
    parser.add_argument("--log", type=Path, nargs="*", default=[], help="logs to split in halves")
    arguments = parser.parse_args()
    print(_HEAD)
    for scene in arguments.scenes:
        for number, seed in enumerate(arguments.seeds):
            first, second = (_synthetic(arguments.out, scene, seed, day) for day in (0, 1))
            run = _built(arguments.out / f"map_{first.name}", open_source(first, SourceConfig()))
            log = open_source(second, SourceConfig())
            _measure(arguments.out, log, run)
            _measure(arguments.out, _glued(log), run, name=f"{second.name} kidnapped")
            if len(arguments.seeds) > 1:
                other = arguments.seeds[(number + 1) % len(arguments.seeds)]
                elsewhere = _synthetic(arguments.out, scene, other, 0)
                there = open_source(elsewhere, SourceConfig())
                foreign = _built(arguments.out / f"map_{elsewhere.name}", there)
                _measure(arguments.out, log, foreign)
    for path in arguments.log:
        log = open_source(path, load_source_config(None, []))
        half = len(log) // 2
        run = _built(arguments.out / f"map_{path.name}", log.subset(np.arange(half)))
        _measure(arguments.out, log.subset(np.arange(half, len(log))), run)


def _synthetic(out: Path, scene: str, seed: int, day: int) -> Path:
    path = out / "logs" / f"{scene}_{seed}_{day}"
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    if scene == "flat":
        config = SynthConfig(
            seed=seed,
            day=day,
            width_px=320,
            height_px=240,
            texture_px_per_m=128,
            frame_rate_hz=10.0,
            image_format="jpg",
        )
        write_tum_log(path, config)
    else:
        usual = LIDAR_SCENES[scene]
        sensor = usual.sensor.model_copy(update={"rings": 32})
        update = {"seed": seed, "day": day, "loop_m": 160.0, "rate_hz": 5.0, "sensor": sensor}
        write_lidar_log(path, usual.model_copy(update=update))
    return path


def _built(out: Path, log: Log) -> tuple[Run, float]:
    if out.exists():
        return open_run(out), float("nan")
    config: BuildConfig = load_config(None, ["min_tracked_frames=5"], sensor=log.sensor)
    began = time.process_time()
    run = build(log, config, out)
    return run, time.process_time() - began


def _glued(log: Log) -> Log:
    """Return the first and the third quarter of a log, glued as if one frame followed the other."""
    quarter = len(log) // 4
    before, after = log.subset(np.arange(quarter)), log.subset(np.arange(2 * quarter, 3 * quarter))
    step_ns = int(np.median(np.diff(log.stamps_ns)))
    shift_ns = int(before.stamps_ns[-1]) + step_ns - int(after.stamps_ns[0])
    return replace(chained(before, after, shift_ns=shift_ns), sessions=())


def _measure(out: Path, log: Log, built: tuple[Run, float], *, name: str = "") -> None:
    run, build_s = built
    name = name or log.path.name
    folder = out / "localised" / f"{name} in {run.path.name}".replace(" ", "_")
    folder.parent.mkdir(exist_ok=True)
    known = load_known_map(run.path)
    config = known.config.model_copy(update={"source": SourceConfig()})
    began = time.process_time()
    try:
        manifest = localise(log, known, config, folder, overwrite=True)
    except MapperError as error:
        cpu_s = time.process_time() - began
        print(f"{name:<22}{run.path.name:<22}refused after {cpu_s:.1f} s: {error}", flush=True)
        return
    cpu_s = time.process_time() - began
    verdict = manifest.verdict.state if manifest.verdict else ""
    errors = _errors(folder, log, run)
    print(
        f"{name:<22}{run.path.name:<22}{manifest.localised_share:>8.1%}{errors}{cpu_s:>8.1f}{build_s:>11.1f}"
        f"  {verdict}",
        flush=True,
    )


def _errors(folder: Path, log: Log, run: Run) -> str:
    poses, records = read_poses(folder / files.POSES), read_records(folder / files.FRAMES)
    is_tracked = np.isin(
        poses.trajectory.stamps_ns, [record.stamp_ns for record in records if record.outcome == "tracked"]
    )
    own, own_truth = run.tracked_trajectory, run.truth
    if log.truth is None or own_truth is None:
        return f"{'no truth':>38}"
    index, gap_ns = nearest(own_truth.stamps_ns, own.stamps_ns)
    near = gap_ns <= MAX_TRUTH_GAP_NS
    T_map_truth, _ = fit_rigid(own.positions_world[near], own_truth.positions_world[index[near]])
    T_truth_own, T_map_own = own_truth.T_world_body[index[near]], own.T_world_body[near]
    at, gap_ns = nearest(log.truth.stamps_ns, poses.trajectory.stamps_ns)
    used = is_tracked & (gap_ns <= MAX_TRUTH_GAP_NS)
    T_map_true = T_map_truth @ log.truth.T_world_body[at]
    T_map_body = poses.trajectory.T_world_body
    miss_m = np.linalg.norm(T_map_body[:, :3, 3] - T_map_true[:, :3, 3], axis=1)
    local_m, nees = [], []
    for k in np.flatnonzero(used):
        T_truth = log.truth.T_world_body[at[k]]
        nearest_own = int(np.linalg.norm(T_truth_own[:, :3, 3] - T_truth[:3, 3], axis=1).argmin())
        T_map_here = T_map_own[nearest_own] @ inverse(T_truth_own[nearest_own]) @ T_truth
        off = inverse(T_map_body[k]) @ T_map_here
        local_m.append(float(np.linalg.norm(off[:3, 3])))
        covariance = poses.covariances[k, 3:, 3:]
        if np.isfinite(covariance).all():
            nees.append(float(off[:3, 3] @ np.linalg.solve(covariance, off[:3, 3])) / 3.0)
    wrong = int((miss_m[used] > _WRONG_M[log.sensor]).sum())
    rmse_m = float(np.sqrt(np.mean(miss_m[used] ** 2)))
    return (
        f"{wrong:>7}{np.median(miss_m[used]):>9.4f}{rmse_m:>9.4f}{np.median(local_m):>13.4f}"
        f"{np.median(nees) if nees else np.nan:>7.1f}"
    )


if __name__ == "__main__":
    main()
