"""Cost of merging: bytes per square kilometre, seconds per job, shuffle, memory; compared with OctoMap.

    python benchmarks/merge_scaling.py [--log logs/street] [--work /tmp/merge] [--resolutions 0.2 0.1]

Runs are overlapping pieces of one drive through a synthetic street, fused at the true poses, so that only
merging is measured; without --log the drive is made first. --copies places the runs side by side, for a map
of many blocks. Every merge is the real command in a separate process; peak memory is that of its largest
process. OctoMap merges the same maps voxel by voxel through ``updateNode``, as its C++ users do; the cost of
its Python binding is bounded by a call that does nothing else.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pyoctomap

from mapper.config.loading import load_config
from mapper.core.deskew import deskewed, twist_at
from mapper.core.timebase import nearest
from mapper.core.trajectory import Trajectory
from mapper.merging.merge import merge
from mapper.merging.world_poses import Placing, as_built
from mapper.octree.map import OctreeMap, read_octree
from mapper.octree.map_file import write_map
from mapper.run.folder import Run, open_run
from mapper.run.manifest import Manifest
from mapper.run.manifest_logs import Input
from mapper.run.writer import write_run
from mapper.simulation.config import LIDAR_SCENES
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.trajectory_files import write_tum

RUNS = 8
SHARE = 1.4  # a run is longer by this ratio than its step along the log: neighbours overlap
PEER_RUNS = 2


@dataclass(frozen=True)
class Cost:
    """Cost of one merge in a process of its own."""

    wall_s: float
    peak_mb: float


def make_runs(source: Log, resolution_m: float, *, stride: int, folder: Path) -> list[Run]:
    """Fuse pieces of a log at the true poses, each as a run folder."""
    truth = source.truth
    if truth is None:
        raise SystemExit(f"{source.path}: has no truth")
    config = load_config(None, [f"octree.resolution_m={resolution_m}"], sensor="lidar")
    indices, _ = nearest(truth.stamps_ns, source.stamps_ns)
    step = len(source) / RUNS
    runs = []
    for number in range(RUNS):
        octree = OctreeMap(config.octree)
        piece = range(round(number * step), min(round((number + SHARE) * step), len(source)), stride)
        for frame in piece:
            scan = deskewed(source.entry_at(frame).scan(), twist_at(truth, int(indices[frame])))
            octree.insert(scan, truth.T_world_body[indices[frame]])
        found = Input(path=str(source.path), kind=source.kind, fingerprint=f"sha256:{number}")
        path = folder / f"run{number}"
        with write_run(path, Manifest(status="building", input=found), config, overwrite=True) as writer:
            write_map(writer.folder / "map.octree", octree)
            poses = truth.T_world_body[indices[list(piece)]]
            write_tum(
                writer.folder / "trajectory.tum", Trajectory(truth.stamps_ns[indices[list(piece)]], poses)
            )
        runs.append(open_run(path))
    return runs


def merged_apart(runs: list[Run], out: Path, *, processes: int, poses: Path | None = None) -> Cost:
    """Merge by the command, in a process of its own."""
    command = [sys.executable, "-c", "from mapper.cli.main import main; main()", "merge"]
    command += [str(run.path) for run in runs]
    command += ["--out", str(out), "--overwrite", "--quiet", "--processes", str(processes)]
    if poses is not None:
        command += ["--poses", str(poses)]
    began = perf_counter()
    child = subprocess.Popen(command)
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)}: failed")
    return Cost(perf_counter() - began, usage.ru_maxrss * 1024 / 1e6)


def print_growth(runs: list[Run], folder: Path, *, copies: int) -> None:
    """Print what merging the first n runs costs, in one process; then all runs in several blocks."""
    print(f"{'runs':>4} {'tiles':>6} {'m²':>8} {'voxels':>11} {'peak MB':>8} {'whole MB':>9} {'wall s':>7}")
    for count in (1, 2, 4, 8):
        print_merge(runs[:count], folder / f"map{count}")
    if copies > 1:
        print_merge(*copied(runs, folder / "copies", copies=copies))


def print_merge(runs: list[Run], out: Path, poses: Path | None = None) -> None:
    """Print a line of that table."""
    cost = merged_apart(runs, out, processes=1, poses=poses)
    manifest = json.loads((out / "manifest.json").read_text())
    whole = read_octree(out / "map.ot")
    print(
        f"{len(runs):4} {len(manifest['tiles']):6} {1e6 * manifest['area_km2']:8.0f} {len(whole):11} "
        f"{cost.peak_mb:8.0f} {whole.memory_bytes / 1e6:9.0f} {cost.wall_s:7.1f}",
        flush=True,
    )


def copied(runs: list[Run], folder: Path, *, copies: int) -> tuple[list[Run], Path, Path]:
    """Return the runs once for each block, where their map is to be, and the file that places them."""
    pitch_m = 2048 * runs[0].config.octree.resolution_m
    many, lines = [], []
    for column, row in np.ndindex(copies, copies):
        for run in runs:
            path = folder / f"{run.path.name}_{column}_{row}"
            shutil.copytree(run.path, path, dirs_exist_ok=True)
            many.append(open_run(path))
            lines.append(f"{path.name} {column * pitch_m!r} {row * pitch_m!r} 0 0 0 0 1")
    poses = folder / "poses.txt"
    poses.write_text("\n".join(lines) + "\n")
    return many, folder.with_name("copied"), poses


def print_costs(runs: list[Run], folder: Path) -> None:
    """Print bytes per area, seconds per job and what two processes gain."""
    found = merge(Placing(as_built(runs)), folder / "map", overwrite=True)
    manifest, area_km2 = found.map.manifest, found.map.manifest.area_km2
    sizes = {"tiles": sum(path.stat().st_size for path in (found.map.path / "tiles").iterdir())}
    sizes |= {name: (found.map.path / name).stat().st_size for name in ("map.ot", "map.bt", "slice.pgm")}
    per_km2 = ", ".join(f"{name} {size / area_km2 / 1e6:.0f}" for name, size in sizes.items())
    input_bytes = sum((run.path / "map.octree").stat().st_size for run in runs)
    print(f"MB/km²: {per_km2}; shuffle {found.shuffle_bytes / area_km2 / 1e6:.0f}")
    print(
        f"MB: {RUNS} runs' maps {input_bytes / 1e6:.2f}, shuffle {found.shuffle_bytes / 1e6:.2f}, "
        f"{100 * found.shuffle_bytes / input_bytes:.0f} %"
    )
    for name, stage in (("split a run", "split"), ("join a tile", "join"), ("slice", "slice")):
        seconds = [cost.seconds for cost in found.costs[stage]]
        print(f"{name}: {len(seconds)} jobs, median {np.median(seconds):.3f} s, max {max(seconds):.3f} s")
    voxels = sum(run.voxels for run in manifest.runs)
    split_s, join_s = (sum(cost.seconds for cost in found.costs[stage]) for stage in ("split", "join"))
    print(f"voxels per second: split {voxels / split_s / 1e6:.1f} M, join {voxels / join_s / 1e6:.1f} M")
    costs = {count: merged_apart(runs, folder / f"p{count}", processes=count) for count in (1, 2)}
    print(
        f"wall: {costs[1].wall_s:.1f} s in one process, {costs[2].wall_s:.1f} s in two: "
        f"{costs[1].wall_s / costs[2].wall_s:.2f}×"
    )


def print_peer(runs: list[Run], folder: Path) -> None:
    """Merge the same maps in OctoMap, voxel by voxel, and compare time and every log-odds."""
    maps = [read_octree(run.path / "map.octree") for run in runs[:PEER_RUNS]]
    OctreeMap(maps[0].config).add(maps[0])  # compiled, or loaded, before it is timed
    began = process_time()
    ours = OctreeMap(maps[0].config)
    for octree in maps:
        ours.add(octree)
    ours_s = process_time() - began
    tree = pyoctomap.OcTree(maps[0].resolution_m)
    tree.setClampingThresMin(1e-9)
    tree.setClampingThresMax(1.0 - 1e-9)
    theirs_s = binding_s = 0.0
    for octree in maps:
        leaves = octree.leaves()
        centres, values = list(leaves.centres_world), leaves.log_odds.tolist()
        began = process_time()
        for centre, value in zip(centres, values, strict=True):
            tree.updateNode(centre, value, True)
        theirs_s += process_time() - began
        began = process_time()
        for centre, _ in zip(centres, values, strict=True):
            tree.coordToKey(centre)
        binding_s += process_time() - began
    tree.updateInnerOccupancy()
    tree.write(str(folder / "theirs.ot"))
    theirs, leaves = read_octree(folder / "theirs.ot").leaves(), ours.leaves()
    equal = np.array_equal(theirs.keys, leaves.keys) and np.array_equal(theirs.log_odds, leaves.log_odds)
    print(
        f"{PEER_RUNS} runs, {len(leaves.keys)} voxels: ours {ours_s:.3f} s CPU, OctoMap {theirs_s:.1f} s, "
        f"{theirs_s / ours_s:.0f}×; without its binding at least {(theirs_s - binding_s) / ours_s:.0f}×; "
        f"{'equal to the last bit' if equal else 'DIFFERENT'}"
    )


def main() -> None:
    """Run every case and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--log", type=Path)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "merge_scaling")
    parser.add_argument("--resolutions", type=float, nargs="+", default=[0.2, 0.1])
    parser.add_argument("--stride", type=int, default=2, help="use every n-th scan")
    parser.add_argument("--copies", type=int, default=1, help="blocks along each side")
    arguments = parser.parse_args()
    log = arguments.log or arguments.work / "street"
    if not log.exists():
        write_lidar_log(log, LIDAR_SCENES["street"])
    source = open_source(log)
    for resolution_m in arguments.resolutions:
        folder = arguments.work / f"{resolution_m:g}"
        print(f"\n{resolution_m:g} m a voxel")
        runs = make_runs(source, resolution_m, stride=arguments.stride, folder=folder / "runs")
        print_growth(runs, folder, copies=arguments.copies)
        print_costs(runs, folder)
        print_peer(runs, folder)


if __name__ == "__main__":
    main()
