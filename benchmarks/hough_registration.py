"""Registration without a guess: Hough voting compared with KISS-Matcher with GICP, in one process.

    python benchmarks/hough_registration.py [--pairs 20] [--data ../shared/data] [--methods …] [--only …]

Each source is rotated by any yaw and offset by up to 10 m (25 m in the rows that say so). A result is right
within 0.3 m and 1° of the truth; "wrong" counts results that were trusted but are not right. Times are CPU
times, and a shared machine can double them: compare them within a run. KITTI's truth is accurate to some
centimetres; KAIST's rotations differ by 0.1 to 0.3° from those of GICP and point-to-plane ICP, which agree to
0.04°. Errors on synthetic scans are those of the method.
"""

import argparse
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Transform, angle_between, inverse
from mapper.evaluators.metrics.map_quality import DistanceTo
from mapper.evaluators.papers.hough_pairs import fewer_rings, merged, perturbed
from mapper.registration.base import Registration
from mapper.registration.config import KissMatcherConfig
from mapper.registration.factory import build_registration
from mapper.registration.hough.aligner import Hough
from mapper.registration.hough.config import HoughConfig, HoughGicpConfig, HoughNdtConfig
from mapper.simulation.config import COURTYARD, STREET, LidarSynthConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.sources import open_source
from mapper.sources.config import SourceConfig

RIGHT_M, RIGHT_DEG = 0.3, 1.0
NEAR_M = 10.0
END_SCANS = 4
MAP_VOXEL_M = 0.05
COLUMNS = (
    *("scans", "method", "right", "wrong", "median cm", "95 % cm"),
    *("median °", "MPD cm (truth's)", "prepare ms", "align ms"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two scans, and the motion between them; None where they show different places."""

    target: Scan
    source: Scan
    T_target_source: Transform | None


@dataclass(frozen=True, slots=True, eq=False)
class PosedScans:
    """Scans with their poses."""

    scans: list[Scan]
    T_world_body: list[Transform]


def recorded(folder: Path) -> PosedScans:
    """Return the scans of a log, those far from its first included."""
    source = open_source(folder, SourceConfig())
    assert source.truth is not None
    scans = [entry.load().scan() for entry in source.entries()]
    return PosedScans(scans, list(source.truth.T_world_body))


def rendered(config: LidarSynthConfig, *, seed: int, count: int) -> PosedScans:
    """Return evenly chosen synthetic scans, each taken at an instant."""
    sensor = config.sensor.model_copy(update={"motion_distortion": False})
    source = LidarSimulator(config.model_copy(update={"seed": seed, "sensor": sensor}))
    poses = source.truth.T_world_body
    chosen = np.linspace(0, len(poses) - 1, count).astype(int)
    return PosedScans([source.observe(int(i)) for i in chosen], [poses[i] for i in chosen])


def near_pairs(logs: list[PosedScans], *, count: int, offset_m: float = NEAR_M) -> Iterator[Pair]:
    """Yield perturbed pairs of scans taken within 10 m of each other, so many over all logs."""
    rng = np.random.default_rng(0)
    for log, share in zip(logs, np.diff(np.linspace(0, count, len(logs) + 1).astype(int)), strict=True):
        centres = np.array([T[:3, 3] for T in log.T_world_body])
        near = [
            (i, j)
            for i, j in itertools.permutations(range(len(centres)), 2)
            if np.linalg.norm(centres[i] - centres[j]) < NEAR_M
        ]
        for k in rng.permutation(len(near))[:share]:
            i, j = near[k]
            target = log.T_world_body[i]
            source, T_world_source = perturbed(
                log.scans[j], log.T_world_body[j], target, rng, offset_m=offset_m
            )
            yield Pair(log.scans[i], source, inverse(target) @ T_world_source)


def without_origins(pairs: Iterator[Pair]) -> Iterator[Pair]:
    """Yield pairs whose sources say that they were seen from the origin of their frame; they were not."""
    for pair in pairs:
        source = Scan(stamp_ns=0, points_body=pair.source.points_body)
        yield Pair(pair.target, source, pair.T_target_source)


def sparse_pairs(logs: list[PosedScans], *, count: int, rings: bool) -> Iterator[Pair]:
    """Yield scans with 16 of 64 rings, or 10 % of their points, against a map of all the others."""
    rng = np.random.default_rng(0)
    for log, share in zip(logs, np.diff(np.linspace(0, count, len(logs) + 1).astype(int)), strict=True):
        middle = log.T_world_body[len(log.scans) // 2]
        for j in rng.permutation(len(log.scans))[:share]:
            thin = sparse(log.scans[j], rng, rings=rings)
            source, T_world_source = perturbed(thin, log.T_world_body[j], middle, rng, offset_m=NEAR_M)
            target = map_of_others(log, without=int(j), T_world_map=middle)
            yield Pair(target, source, inverse(middle) @ T_world_source)


def sparse(scan: Scan, rng: np.random.Generator, *, rings: bool) -> Scan:
    """Return every fourth ring, by elevation, or one point in ten."""
    if rings:
        return fewer_rings(scan)
    keep = rng.random(len(scan.points_body)) < 0.1
    return Scan(stamp_ns=scan.stamp_ns, points_body=scan.points_body[keep], origin_body=scan.origin_body)


def map_of_others(log: PosedScans, *, without: int, T_world_map: Transform) -> Scan:
    """Return a dense map of all scans but one."""
    scans = [scan for i, scan in enumerate(log.scans) if i != without]
    poses = [inverse(T_world_map) @ T for i, T in enumerate(log.T_world_body) if i != without]
    return merged(scans, poses, voxel_m=MAP_VOXEL_M)


def far_pairs(log: PosedScans, *, count: int) -> Iterator[Pair]:
    """Yield pairs from the two ends of a log: the answer lies at the accumulator's edge or beyond."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        i, j = rng.integers(END_SCANS), len(log.scans) - 1 - rng.integers(END_SCANS)
        body = log.T_world_body[j]
        source, T_world_source = perturbed(log.scans[j], body, body, rng, offset_m=NEAR_M)
        yield Pair(log.scans[i], source, inverse(log.T_world_body[i]) @ T_world_source)


def strangers(logs: list[PosedScans], *, count: int) -> Iterator[Pair]:
    """Yield pairs of scans of different logs, which show different places."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        a, b = (logs[k] for k in rng.choice(len(logs), 2, replace=False))
        i, j = rng.integers(len(a.scans)), rng.integers(len(b.scans))
        source, _ = perturbed(b.scans[j], b.T_world_body[j], b.T_world_body[j], rng, offset_m=NEAR_M)
        yield Pair(a.scans[i], source, None)


def measure(name: str, method: Registration, pairs: Iterator[Pair]) -> str:
    """Return a row of the table: one method on one set of pairs."""
    total = right = wrong = 0
    errors_m, errors_deg, mpd_m, true_mpd_m, prepare_s, align_s = [], [], [], [], [], []
    for pair in pairs:
        total += 1
        began = time.process_time()
        aligner = method.prepare(pair.target)
        prepared = time.process_time()
        alignment = aligner.align(pair.source, np.eye(4))
        prepare_s.append(prepared - began)
        align_s.append(time.process_time() - prepared)
        if not alignment.converged:
            continue
        if pair.T_target_source is None:
            wrong += 1
            continue
        miss = inverse(pair.T_target_source) @ alignment.T_target_source
        error_m = float(np.linalg.norm(miss[:3, 3]))
        error_deg = float(np.degrees(angle_between(miss[:3, :3], np.eye(3))))
        if error_m >= RIGHT_M or error_deg >= RIGHT_DEG:
            wrong += 1
            continue
        right += 1
        errors_m.append(error_m)
        errors_deg.append(error_deg)
        target = DistanceTo(pair.target.points_body)
        mpd_m.append(target.of(pair.source.points_body, alignment.T_target_source).mpd_m)
        true_mpd_m.append(target.of(pair.source.points_body, pair.T_target_source).mpd_m)
    cells = [f"{right}/{total}", f"{wrong}"]
    if right:
        cells += [f"{100 * np.median(errors_m):.1f}", f"{100 * np.percentile(errors_m, 95):.1f}"]
        cells += [
            f"{np.median(errors_deg):.2f}",
            f"{100 * np.median(mpd_m):.1f} ({100 * np.median(true_mpd_m):.1f})",
        ]
    else:
        cells += ["–"] * 4
    cells += [f"{1e3 * np.median(prepare_s):.0f}", f"{1e3 * np.median(align_s):.0f}"]
    return f"| {name} | " + " | ".join(cells) + " |"


def stages(config: HoughGicpConfig, pair: Pair) -> str:
    """Return the time of every step of one registration, the best of five."""
    aligner = Hough(config).prepare(pair.target)
    runs = [aligner.stages(pair.source).seconds for _ in range(5)]
    return ", ".join(f"{name} {1e3 * min(run[name] for run in runs):.0f} ms" for name in runs[0])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared/data")
    parser.add_argument("--pairs", type=int, default=20, help="pairs per row")
    parser.add_argument("--methods", nargs="+", default=["hough-gicp", "hough-ndt", "kiss-matcher"])
    parser.add_argument("--only", default="", help="only sets whose name holds this")
    arguments = parser.parse_args()
    count = arguments.pairs

    kitti, kaist = (recorded(arguments.data / name) for name in ("kitti_00", "mulran_kaist03"))
    courtyards = [rendered(COURTYARD, seed=seed, count=16) for seed in range(5)]
    avenues = [rendered(STREET, seed=seed, count=8) for seed in range(2)]
    configs = {
        "hough-gicp": HoughGicpConfig(),
        "hough-ndt": HoughNdtConfig(),
        "kiss-matcher": KissMatcherConfig(),
    }
    sets = {
        "street kitti_00": lambda: near_pairs([kitti], count=count),
        "street kaist03": lambda: near_pairs([kaist], count=count),
        "street, origins unknown": lambda: without_origins(near_pairs([kitti, kaist], count=count)),
        "street, offset ≤ 25 m": lambda: near_pairs([kitti, kaist], count=count, offset_m=25.0),
        "courtyards, tilt ≤ 30°": lambda: near_pairs(courtyards, count=count),
        "16 of 64 rings in kitti's map": lambda: sparse_pairs([kitti], count=count, rings=True),
        "16 of 64 rings in kaist's map": lambda: sparse_pairs([kaist], count=count, rings=True),
        "random 10 % in kitti's map": lambda: sparse_pairs([kitti], count=count, rings=False),
        "random 10 % in kaist's map": lambda: sparse_pairs([kaist], count=count, rings=False),
        "strangers: kitti, kaist, streets": lambda: strangers([kitti, kaist, *avenues], count=count),
        "strangers: courtyards": lambda: strangers(courtyards, count=count),
        "20 m down the street": lambda: far_pairs(kaist, count=count),
    }
    print("| " + " | ".join(COLUMNS) + " |\n" + "| --- " * len(COLUMNS) + "|")
    for title, pairs in sets.items():
        for name in arguments.methods if arguments.only in title else ():
            config = configs[name]
            if "25 m" in title and isinstance(config, HoughConfig):
                wide = config.voting.model_copy(update={"max_offset_m": 25.0})
                config = config.model_copy(update={"voting": wide})
            method = build_registration(config)
            print(f"| {title} " + measure(name, method, pairs()), flush=True)
    print(f"\nkitti_00, hough-gicp: {stages(configs['hough-gicp'], next(near_pairs([kitti], count=1)))}")


if __name__ == "__main__":
    main()
