"""The hard set: logs that are hard to track, and whether a run that fails reports it.

    python benchmarks/hard_set.py CACHE [--data DATA] [--only NAME…] [--seed 1] [--set key=value] [--json OUT]
    python benchmarks/hard_set.py CACHE --neighbours --only NAME --seed 1 2 3 4 5
    python benchmarks/hard_set.py CACHE --from JSON…

Logs are made once by `mapper synth` and kept in CACHE. With DATA also the real logs with truth in it are
mapped, some at several strides. Each log is tracked, searched for loops and solved with
the default settings, and doubtful frames are placed as in a run; no map is made.

`ATE`: RMSE of the placed frames, SE(3)-aligned, in metres; `path`: length of the true path. `tracked`,
`doubtful` and `lost`: frames. `f/r`: share of right frames that are called doubtful. `wrong`: windows of 1 s
whose relative pose is off by more than 0.2 m or 5 degrees and, where covariances are known, by more than
5 sigma; `silent`: those of them without a doubtful or lost frame (evaluators/metrics/silent_failures.py).
`false`: accepted loops farther than 0.2 m or 0.1 rad from the truth, of all accepted
(evaluators/metrics/loops.py). `verdict`: whether the run would be trusted (docs/verdict.md).

At the end is a table for each kind of sensor: runs that are right and whole (RMSE at most 1 % of the path or
2 cm, at most 2 % of the frames lost) against the verdict, and every run for which the two differ.
`--neighbours` and `--from JSON …` give it many runs.
"""

import argparse
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from hard_logs import HARD_LOGS
from scipy.spatial.transform import Rotation

from mapper.cli.main import app
from mapper.config.build import BuildConfig
from mapper.config.loading import load_config, load_source_config
from mapper.core.errors import MapperError
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.loops import wrong_loops
from mapper.evaluators.metrics.silent_failures import check_doubts
from mapper.evaluators.metrics.trajectory_errors import align, associate, ate_rmse_m
from mapper.loops.closure import accepted_loops
from mapper.pipeline.build import level_of
from mapper.pipeline.component_loops import joined
from mapper.pipeline.disconnected_components import largest_component
from mapper.pipeline.lidar_adjustment import adjust_tracking
from mapper.pipeline.solve import solve
from mapper.pipeline.track import noted_log_warnings, track_log
from mapper.pipeline.tracking_result import TrackingResult, from_tracking, refuse_a_fragment
from mapper.run.doubtful_frames import without_doubtful
from mapper.run.manifest import Levelling, Verdict
from mapper.run.pose_covariances import uncertain_poses
from mapper.run.results import RunResults
from mapper.run.stored_tracking import StoredTracking
from mapper.run.verdict import find_warnings, verdict_of
from mapper.run.writer import first_manifest
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from mapper.sources.base import Log

REAL_LOGS: Mapping[str, Sequence[int]] = {
    "tum_fr1_xyz": (1, 5, 10, 15, 30),
    "tum_fr3_teddy": (1, 2, 3),
    "tum_fr3_cabinet_1_5hz": (1,),
    "kitti_00": (1, 2, 3),
    "mulran_kaist03": (1, 2, 3),
    "courtyard_2hz": (1,),
}
"""Folders of real logs, and at which strides they are mapped."""

NEIGHBOURS: Mapping[str, Sequence[Sequence[str]]] = {
    "rgbd": (
        *([f"odometry.max_depth_m={value}"] for value in (3.0, 5.0, 6.0)),
        *([f"odometry.detector.max_features={value}"] for value in (800, 1300)),
        *([f"odometry.keyframe_ratio={value}"] for value in (0.65, 0.85)),
        ["odometry.bundle_keyframes=7"],
        ["odometry.local_keyframes=10"],
        ["odometry.search_px=20"],
    ),
    "lidar": (
        *([f"odometry.max_range_m={value}"] for value in (60.0, 80.0)),
        *([f"odometry.voxel_m={value}"] for value in (0.3, 0.5)),
        *([f"odometry.keyframe_distance_m={value}"] for value in (0.7, 1.4)),
        *([f"odometry.cell_m={value}"] for value in (0.4, 0.7)),
        ["odometry.max_pair_distance_m=0.7"],
        ["odometry.keyframe_angle_rad=0.3"],
    ),
}
"""Ten settings beside the defaults by sensor; strides 2 and 3 make them twelve."""

_GOOD_M, _GOOD_SHARE, _GOOD_LOST = 0.02, 0.01, 0.02


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one log; numbers are None where the log was refused.

    Attributes:
        log: Its name, with its stride.
        frames: Frames of the log.
        path_m: Length of the true path.
        tracked: Frames that are placed, and of which nothing is doubted.
        doubtful: Frames that are placed with a doubt.
        lost: Frames that are not placed.
        ate_m: RMSE of the placed frames.
        flagged_right_ratio: Share of the right frames that are called doubtful.
        wrong: Windows that are wrong.
        silent: Windows that are wrong, and nothing is said.
        silent_at_s: When they begin.
        worst_silent_m: Largest error of their translations.
        loops: Accepted loops.
        false_loops: Number of these that are wrong.
        seconds: Wall time of tracking and solving.
        refused: Why no path was made; empty if one was.
        sensor: Kind of its sensor.
        verdict: That of a run of it.
        doubts: Reasons against it.
        worst_m: Largest error of a frame that is not doubtful.
        worst_rad: Largest error of the rotation of one.
    """

    log: str
    frames: int
    path_m: float
    tracked: int = 0
    doubtful: int = 0
    lost: int = 0
    ate_m: float | None = None
    flagged_right_ratio: float | None = None
    wrong: int | None = None
    silent: int | None = None
    silent_at_s: tuple[float, ...] = ()
    worst_silent_m: float | None = None
    loops: int | None = None
    false_loops: int | None = None
    seconds: float = 0.0
    refused: str = ""
    sensor: str = ""
    verdict: str = ""
    doubts: Sequence[str] = ()
    worst_m: float = 0.0
    worst_rad: float = 0.0

    @property
    def is_good(self) -> bool:
        """Whether the path is right and whole."""
        if self.ate_m is None or self.lost > _GOOD_LOST * self.frames:
            return False
        return self.ate_m <= max(_GOOD_M, _GOOD_SHARE * self.path_m)


HEADER = (
    f"{'log':<22} {'frames':>6} {'path m':>7} {'ATE m':>8} {'tracked':>7} {'doubtf.':>7} {'lost':>5} "
    f"{'f/r %':>6} {'wrong':>5} {'silent':>6} {'worst m':>7} {'loops':>5} {'false':>5} {'s':>6}  verdict"
)


def line(row: Row) -> str:
    """Return a row of the table."""
    start = f"{row.log:<22} {row.frames:>6} {row.path_m:>7.2f} "
    if row.ate_m is None or row.flagged_right_ratio is None:
        return f"{start}refused: {row.refused}"
    return (
        f"{start}{row.ate_m:>8.4f} {row.tracked:>7} {row.doubtful:>7} {row.lost:>5} "
        f"{100 * row.flagged_right_ratio:>6.1f} {row.wrong:>5} {row.silent:>6} {row.worst_silent_m:>7.2f} "
        f"{row.loops:>5} {row.false_loops:>5} {row.seconds:>6.1f}  {row.verdict}"
    )


def mapped(log: Log, name: str, overrides: Sequence[str] = ()) -> Row:
    """Track and solve a log as ``mapper build`` does, and compare with the truth.

    Raises:
        SystemExit: The log has no truth.
    """
    if log.truth is None:
        raise SystemExit(f"{log.path}: has no truth to measure against")
    stamps_ns = log.stamps_ns
    during = (log.truth.stamps_ns >= stamps_ns[0]) & (log.truth.stamps_ns <= stamps_ns[-1])
    path_m = float(np.linalg.norm(np.diff(log.truth.positions_world[during], axis=0), axis=1).sum())
    config = load_config(None, overrides, sensor=log.sensor)
    began = time.perf_counter()
    row = Row(name, len(log), path_m, sensor=log.sensor)
    try:
        tracking = solved(log, config)
        row = replace(row, seconds=time.perf_counter() - began)
        return compared(row, log, config, tracking, log.truth)
    except MapperError as error:
        return replace(row, refused=str(error))


def solved(log: Log, config: BuildConfig) -> TrackingResult:
    """Return a log tracked and solved as ``mapper build`` does.

    Raises:
        TrackingError: Too few frames could be tracked.
    """
    tracking = joined(log, track_log(log, config, progress=SILENT), config, progress=SILENT)
    tracking = largest_component(tracking, progress=SILENT)
    if len(log) >= 2 * config.min_tracked_frames:  # a short log at a long stride is judged all the same
        refuse_a_fragment(tracking, config, sensor=log.sensor)
    graph = solve(tracking.graph, tracking.loops, config.graph)
    tracking = replace(tracking, graph=graph.graph, loops=graph.loops)
    return adjust_tracking(log, largest_component(tracking, progress=SILENT), config)[0]


def compared(row: Row, log: Log, config: BuildConfig, tracking: TrackingResult, truth: Trajectory) -> Row:
    """Return a row with the errors of a solved log and with the verdict that a run of it gets.

    Raises:
        MapperError: The path and the truth have too few times in common.
    """
    stored = from_tracking(tracking, log)
    rmse_m = ate_rmse_m(stored.trajectory, truth)
    sure = associate(without_doubtful(stored.trajectory, stored.records), truth)
    sure = align(sure, "se3").moved(sure)
    turned = Rotation.from_matrix(
        sure.T_truth_body[:, :3, :3] @ sure.T_map_body[:, :3, :3].transpose(0, 2, 1)
    )
    check = check_doubts(tracking.trajectory(), stored.records, truth)
    accepted = accepted_loops(tracking.loops)
    outcomes = [record.outcome for record in stored.records]
    found = verdict(log, config, tracking, stored)
    return replace(
        row,
        tracked=outcomes.count("tracked"),
        doubtful=outcomes.count("doubtful"),
        lost=outcomes.count("lost") + outcomes.count("skipped"),
        ate_m=rmse_m,
        flagged_right_ratio=check.flagged_right_ratio,
        wrong=check.wrong,
        silent=check.silent,
        silent_at_s=check.silent_at_s,
        worst_silent_m=check.worst_m,
        loops=len(accepted),
        false_loops=sum(wrong_loops(accepted, truth)),
        verdict=found.state,
        doubts=found.sentences,
        worst_m=float(sure.position_errors_m.max()),
        worst_rad=float((turned.mean().inv() * turned).magnitude().max()),
    )


def verdict(log: Log, config: BuildConfig, tracking: TrackingResult, stored: StoredTracking) -> Verdict:
    """Return the verdict on a run of a solved log, with no warning that rests on the truth."""
    level = level_of(log, tracking, config)
    levelling = Levelling(method=level.method, detail=level.detail, has_floor=level.has_floor)
    warnings = (*noted_log_warnings(log, SILENT), *tracking.warnings)
    manifest = first_manifest(log).model_copy(update={"warnings": warnings, "levelling": levelling})
    poses = uncertain_poses(stored.trajectory, stored.graph, stored.records)
    results = RunResults(
        stored.trajectory, stored.graph, stored.records, stored.loops, stored.frame_ms, None, poses
    )
    return verdict_of(find_warnings(results, manifest))


def logs(
    cache: Path, data: Path | None, only: Sequence[str], seeds: Sequence[int], overrides: Sequence[str] = ()
) -> Iterator[tuple[str, str, Log]]:
    """Yield every log with its name and its label; synthetic ones are made where they are not there yet.

    Raises:
        SystemExit: A name is unknown.
    """
    config = load_source_config(None, overrides)
    real = {name: strides for name, strides in REAL_LOGS.items() if data and (data / name).exists()}
    if unknown := set(only) - set(HARD_LOGS) - set(real):
        raise SystemExit(f"no log is called {', '.join(sorted(unknown))}; want of {[*HARD_LOGS, *real]}")
    for name, hard in HARD_LOGS.items():
        for seed in seeds if not only or name in only else ():
            folder = cache / (name if seed == 1 else f"{name}_s{seed}")
            if not folder.exists():
                arguments = ["synth", str(folder), *hard.arguments, "--seed", str(seed), "--quiet"]
                app(arguments, standalone_mode=False)
            yield name, folder.name, open_source(folder, config)
    for name, strides in real.items():
        if data and (not only or name in only):
            log = open_source(data / name, config)
            for stride in strides:
                yield name, f"{name}:{stride}", every(log, stride)


def every(log: Log, stride: int) -> Log:
    """Return a log with every ``stride``-th frame."""
    return log.subset(np.arange(0, len(log), stride))


def neighbours(log: Log, name: str, overrides: Sequence[str]) -> list[Row]:
    """Map a log with the defaults, with ten neighbouring settings, and at every 2nd and 3rd frame."""
    rows = [mapped(log, name, overrides)]
    print(line(rows[0]), flush=True)
    for setting in NEIGHBOURS[log.sensor]:
        label = f"{name} {setting[0].removeprefix('odometry.')}"
        rows.append(mapped(log, label, [*overrides, *setting]))
        print(line(rows[-1]), flush=True)
    for stride in (2, 3):
        rows.append(mapped(every(log, stride), f"{name} stride {stride}", overrides))
        print(line(rows[-1]), flush=True)
    print(summary(name, [rows]))
    return rows


def summary(name: str, runs: Sequence[Sequence[Row]]) -> str:
    """Return the median and worst neighbour of a log in a line; of several seeds, by each one's median.

    The error of one short log depends on its noise as much as on the settings: alone it varies by the same
    factor that is looked for between settings.
    """
    errors_m = np.array([[np.inf if row.ate_m is None else row.ate_m for row in rows[1:]] for rows in runs])
    pooled_m = np.median(errors_m, axis=0)
    median_m, worst = float(np.median(pooled_m)), int(np.argmax(pooled_m))
    silent = max(row.silent or 0 for rows in runs for row in rows)
    seeds = f" by the medians of {len(runs)} seeds" if len(runs) > 1 else ""
    worst_m = pooled_m[worst]
    return (
        f"{name}: {len(pooled_m)} neighbours{seeds}: ATE median {median_m:.4f} m, worst {worst_m:.4f} m "
        f"({worst_m / median_m:.2f} times the median: {runs[0][1 + worst].log}); most silent windows {silent}"
    )


def reliability(rows: Sequence[Row]) -> str:
    """Return how verdicts and errors agree, by sensor, and the runs in which they do not."""
    lines = ["sensor   runs  good  trusted  good of trusted  trusted of good"]
    for sensor in ("rgbd", "lidar"):
        of_sensor = [row for row in rows if row.sensor == sensor]
        good = [row for row in of_sensor if row.is_good]
        trusted = [row for row in of_sensor if row.verdict == "trusted"]
        both = sum(row.is_good for row in trusted)
        shares = [f"{both / len(one):.0%}" if one else "–" for one in (trusted, good)]
        lines.append(
            f"{sensor:<6} {len(of_sensor):>6} {len(good):>5} {len(trusted):>8} {shares[0]:>16} "
            f"{shares[1]:>16}"
        )
    for row in rows:
        if row.ate_m is not None and row.is_good != (row.verdict == "trusted"):
            share = row.ate_m / row.path_m
            lines.append(
                f"{row.log:<30} {row.ate_m:.4f} m, {share:.1%} of the path, {row.lost} lost: {row.verdict}"
                + "".join(f"\n    {sentence}" for sentence in row.doubts)
            )
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cache", type=Path, help="folder of the synthetic logs")
    parser.add_argument("--data", type=Path, help="folder of the real logs")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these logs")
    parser.add_argument("--seed", type=int, nargs="+", default=[1], help="of the synthetic logs")
    parser.add_argument("--set", dest="overrides", action="append", default=[], help="key.path=value")
    parser.add_argument("--neighbours", action="store_true", help="12 neighbouring settings on each log")
    parser.add_argument("--json", type=Path, help="file for the table as JSON")
    parser.add_argument("--from", dest="known", type=Path, nargs="+", help="such files; nothing is mapped")
    arguments = parser.parse_args()
    if arguments.known:
        print(reliability([Row(**row) for path in arguments.known for row in json.loads(path.read_text())]))
        return
    cv2.setNumThreads(1)
    arguments.cache.mkdir(parents=True, exist_ok=True)
    print(HEADER)
    rows: list[Row] = []
    runs: dict[str, list[list[Row]]] = {}
    for name, label, log in logs(
        arguments.cache, arguments.data, arguments.only, arguments.seed, arguments.overrides
    ):
        if arguments.neighbours:
            runs.setdefault(name, []).append(neighbours(log, label, arguments.overrides))
            rows += runs[name][-1]
        else:
            rows.append(mapped(log, label, arguments.overrides))
            print(line(rows[-1]), flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    for name, of_seeds in runs.items():
        if len(of_seeds) > 1:
            print(summary(name, of_seeds))
    print(reliability(rows))
    if not arguments.neighbours:
        silent = [row.log for row in rows if row.silent]
        false = sum(row.false_loops or 0 for row in rows)
        refused = [row.log for row in rows if row.refused]
        print(
            f"{len(rows)} logs: silent failures in {len(silent)} ({', '.join(silent) or 'none'}), "
            f"{false} false loops, refused {len(refused)} ({', '.join(refused) or 'none'})"
        )


if __name__ == "__main__":
    main()
